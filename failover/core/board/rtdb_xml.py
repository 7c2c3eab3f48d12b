"""RTDB2's ``rtdb2_configuration.xml`` and its successors' as items: keys with shared, period and phase.

The file has no sizes, because RTDB2 stores each object as MessagePack encodes it: each key is a msgpack item of `SIZE` bytes
until a person declares more. Networks, compression and time limits of the file concern RTDB2's own processes and are left out.
Source: config/rtdb2_configuration.xml of CAMBADA/cambada-rtdb2 and of Falcons-Robocup/code.
"""

from __future__ import annotations

import xml.parsers.expat
from typing import Final, NoReturn

from checkpoint.sentences import near
from failover.core.board.items import Item
from failover.core.board.rtdb_conf import TEXT_SIZE_MAX
from failover.errors import FileMistakeError, ItemError

SIZE: Final = 1024
"""Bytes of a key's value: the most that a frame of a radio holds beside its headers."""

KEY: Final = "key"
DEFAULTS: Final = "DefaultKeyValue"
KNOWN: Final = ("id", "shared", "period", "phase", "timeout", "oid")
"""Attributes of a key."""

DEPTH_MAX: Final = 16


def parse(content: bytes, source: str, size: int = SIZE) -> tuple[Item, ...]:
    """The keys of a file as items, in its order.

    Args:
        size: the most bytes of each value.

    Raises:
        FileMistakeError: "file:line:column: what was expected".
    """
    return _Reader(content, source, size).items()


class _Reader:
    """Reads the elements from the first to the last."""

    def __init__(self, content: bytes, source: str, size: int) -> None:
        self._content, self._source, self._size = content, source, size
        self._items: dict[str, tuple[int, Item]] = {}
        self._open: list[str] = []
        self._defaults: dict[str, str] = {}
        self._parser = xml.parsers.expat.ParserCreate()
        self._parser.StartElementHandler = self._begin
        self._parser.EndElementHandler = lambda _: self._open.pop()
        self._parser.StartDoctypeDeclHandler = self._doctype

    def items(self) -> tuple[Item, ...]:
        if len(self._content) > TEXT_SIZE_MAX:
            raise FileMistakeError(f"{self._source}:1:1: {len(self._content)} bytes are over the limit of {TEXT_SIZE_MAX}")
        try:
            self._parser.Parse(self._content, True)
        except xml.parsers.expat.ExpatError as error:
            said = xml.parsers.expat.ErrorString(error.code)
            raise FileMistakeError(f"{self._source}:{error.lineno}:{error.offset + 1}: this is not XML: {said}") from None
        return tuple(item for _, item in self._items.values())

    def _doctype(self, *_: object) -> None:
        self._mistake("a document type is not read here: it could name other files; remove it")

    def _begin(self, name: str, attributes: dict[str, str]) -> None:
        self._open.append(name)
        if len(self._open) > DEPTH_MAX:
            self._mistake(f"elements lie deeper than {DEPTH_MAX} in each other")
        if len(self._open) == 1 and not name.lower().startswith("rtdb"):
            self._mistake(f"expected the element RtDB2Configuration, found {name[:40]!r}")
        if name == DEFAULTS:
            self._defaults = attributes
        elif name.lower() == KEY:
            self._key(attributes)

    def _key(self, attributes: dict[str, str]) -> None:
        for attribute in attributes:
            if attribute not in KNOWN:
                self._mistake(f"unknown attribute {attribute[:40]!r} of a key{near(attribute, KNOWN)}")
        name = attributes.get("id", "")
        if not name:
            self._mistake("expected an attribute id: a key without a name")
        if name in self._items:
            self._mistake(f"key {name} is declared already, in line {self._items[name][0]}")
        said = self._defaults | attributes
        try:
            item = Item(
                name,
                "msgpack",
                size=self._size,
                shared=self._truth(name, said.get("shared", "true")),
                period=self._number(name, "period", said.get("period", "1")),
                phase=self._number(name, "phase", said.get("phase", "0")),
            )
        except ItemError as error:
            self._mistake(f"key {name}: {error}")
        self._items[name] = (self._parser.CurrentLineNumber, item)

    def _truth(self, name: str, text: str) -> bool:
        if text.lower() not in ("true", "false", "1", "0"):
            self._mistake(f"key {name}: shared is true or false, not {text[:40]!r}")
        return text.lower() in ("true", "1")

    def _number(self, name: str, attribute: str, text: str) -> int:
        if not text.isascii() or not text.isdigit() or len(text) > 9:
            self._mistake(f"key {name}: {attribute} is a number of rounds, not {text[:40]!r}")
        return int(text)

    def _mistake(self, sentence: str) -> NoReturn:
        raise FileMistakeError(
            f"{self._source}:{self._parser.CurrentLineNumber}:{self._parser.CurrentColumnNumber + 1}: {sentence}"
        )
