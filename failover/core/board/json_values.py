"""Values of items as JSON: what people read and type, what recordings hold, and the JSON Schema of each type.

Bytes are hexadecimal text; a number that is not finite is null.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from failover.core.board.item_types import Array, Number, Opaque, Record, Text, Type, is_octets
from failover.errors import ValueMisfitError


def plain(value: Any) -> Any:
    """A value as JSON can say it: bytes as hexadecimal, numbers that are not finite as None, arrays as lists."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, int | str):
        return value
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    if isinstance(value, dict | Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, bytes | bytearray | memoryview):
        return bytes(value).hex()
    return value


def of_json(kind: Type, value: Any, place: str) -> Any:
    """A value of JSON for an item: hexadecimal text where bytes belong.

    Args:
        place: the item and the fields that lead here, for the message.

    Raises:
        ValueMisfitError: it is no hexadecimal text.
    """
    if (isinstance(kind, Opaque) and kind.kind == "bytes") or is_octets(kind):
        if isinstance(value, str):
            try:
                return bytes.fromhex(value)
            except ValueError:
                raise ValueMisfitError(f'{place}: bytes are written in hexadecimal, as in "00ff", not {value[:40]!r}') from None
        return value
    if isinstance(kind, Record) and isinstance(value, dict):
        kinds = dict(kind.fields)
        return {name: of_json(kinds[name], inner, f"{place}.{name}") if name in kinds else inner for name, inner in value.items()}
    if isinstance(kind, Array) and isinstance(value, list):
        return [of_json(kind.of, inner, f"{place}[{index}]") for index, inner in enumerate(value)]
    return value


def says_all(kind: Type) -> bool:
    """Whether JSON has each value of a type as it is, as long as its numbers are finite."""
    if isinstance(kind, Record):
        return all(says_all(inner) for _, inner in kind.fields)
    if isinstance(kind, Array):
        return not is_octets(kind) and says_all(kind.of)
    return isinstance(kind, Number)


def schema_of(kind: Type) -> dict[str, Any] | None:
    """The JSON Schema of a type's values, as `plain` writes them.

    None for what Foxglove and Lichtblick refuse in a schema: arrays of arrays, and contents of any type (msgpack, json). A struct
    leaves such fields out; the values have them nevertheless. Source: lichtblick, packages/mcap-support/src/parseJsonSchema.ts.
    """
    if isinstance(kind, Opaque):
        return {"type": "string", "description": "hexadecimal"} if kind.kind == "bytes" else None
    if isinstance(kind, Number):
        return _number(kind.code)
    if isinstance(kind, Text):
        return {"type": "string"}
    if is_octets(kind):
        return {"type": "string", "description": "hexadecimal"}
    if isinstance(kind, Array):
        items = schema_of(kind.of)
        if items is None or items["type"] == "array":
            return None
        return {"type": "array", "items": items, "minItems": kind.count, "maxItems": kind.count}
    found = {name: schema_of(inner) for name, inner in kind.fields}
    properties = {name: inner for name, inner in found.items() if inner is not None}
    return {"type": "object", "properties": properties, "required": list(found)}


def _number(code: str) -> dict[str, Any]:
    if code == "bool":
        return {"type": "boolean"}
    if code[0] == "f":
        return {"type": "number"}
    bits = 8 * int(code[1])
    least, most = (0, 2**bits - 1) if code[0] == "u" else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    return {"type": "integer", "minimum": least, "maximum": most}
