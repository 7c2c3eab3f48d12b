"""A schema: the compiled plan by which one program's state becomes bytes and comes back.

The bytes are msgpack: an array of four, [``FORMAT``, version, fingerprint, state]; `failover.state.wire` defines a state's parts.
The same value by the same schema gives the same bytes, so a commit that changed nothing changes no page.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import msgspec
import numpy as np
from blake3 import blake3
from msgspec import Struct

from failover.errors import FitError, KeepError, SchemaError, StateError, StateFormatError
from failover.state.annotations import Compiler, default_of
from failover.state.declare import MISSING, Field
from failover.state.kinds import Allocate, Build, Kind, Region, Walk, refuse_size
from failover.state.records import RecordField
from failover.state.unions import AnyKind
from failover.state.wire import DATA_SIZE_MAX, FORMAT, INLINE_SIZE_MAX, REGION_COUNT_MAX, SAME, Place, Wire, root_place

FINGERPRINT_SIZE = 16
"""Bytes."""

VERSION_MAX = (1 << 31) - 1

_PACKED_SAME = msgspec.msgpack.encode(SAME)

Migration = Callable[[Any], Any]
"""State of one version → state of the next, on plain values: enums are text, flags tuples of text, records ``PlainRecord``
(a dict), values of a union ``Labelled`` where it takes that, pickled ones ``Unread``; everything else is itself."""


class Encoded(Struct, frozen=True):
    """A state as bytes.

    Attributes:
        data: everything but the regions.
        regions: arrays and long bytes, by name; see ``Region`` for how long their memory is valid.
    """

    data: bytes
    regions: tuple[Region, ...] = ()


class Decoded(Struct, frozen=True):
    """A state that was read.

    Attributes:
        value: of the declared type.
        notes: fields that were dropped, took their default or were migrated: one sentence each.
        version: of the schema that stored it.
    """

    value: Any
    notes: tuple[str, ...]
    version: int


class Stored(Struct, frozen=True):
    """A state as its bytes describe it, before anything is built.

    Attributes:
        wire: the state.
        shared: whether it holds second ways to objects.
    """

    version: int
    fingerprint: bytes
    wire: Wire
    shared: bool


class Schema(Struct, frozen=True):
    """How one program's state is stored. Made once, when the program starts.

    Attributes:
        name: of the state; every place begins with it.
        version: of the declaration; stored with the state.
        fingerprint: digest of the declaration: equal where nothing changed, on every Python and numpy.
        description: the declaration in words.
    """

    name: str
    version: int
    fingerprint: bytes
    description: str
    _kind: Kind
    _place: Place
    _prefix: bytes
    _default: Callable[[], Any] | None
    _migrations: Mapping[int, Migration]
    _open: AnyKind
    _encode: Callable[[Wire], bytes]

    @classmethod
    def of(
        cls,
        annotation: Any,
        default: Any = MISSING,
        *,
        name: str = "state",
        version: int = 1,
        migrations: Mapping[int, Migration] | None = None,
        pickled: bool = False,
    ) -> Schema:
        """The schema of one value.

        Args:
            annotation: its type; MISSING: that of the default.
            default: the value that ``fresh`` copies.
            migrations: by the version that they start from; each makes the next version of a state.
            pickled: stored by pickle; a person who can write the stored state can then run code in the program.

        Raises:
            SchemaError: it cannot be kept; names the field.
        """
        compiler = Compiler()
        declared = Field(annotation, default, pickled=pickled)
        try:
            kind = compiler.field(declared, name)
        except RecursionError as error:
            raise _endless(name) from error
        return cls._made(compiler, kind, default_of(declared), name, version, migrations or {})

    @classmethod
    def of_fields(
        cls,
        fields: Mapping[str, Field],
        *,
        name: str = "state",
        version: int = 1,
        migrations: Mapping[int, Migration] | None = None,
    ) -> Schema:
        """The schema of a component: its value is a dict of its kept fields, so that an object in two of them stays one.

        Raises:
            SchemaError: one cannot be kept; names it.
        """
        compiler = Compiler()
        try:
            kind = compiler.component(name, fields)
        except RecursionError as error:
            raise _endless(name) from error
        return cls._made(compiler, kind, lambda: _fresh_fields(kind.fields, name), name, version, migrations or {})

    @classmethod
    def _made(
        cls,
        compiler: Compiler,
        kind: Kind,
        default: Callable[[], Any] | None,
        name: str,
        version: int,
        migrations: Mapping[int, Migration],
    ) -> Schema:
        if not 1 <= version <= VERSION_MAX:
            raise SchemaError(f"cannot keep {name}: version {version} is not from 1 to {VERSION_MAX}", name)
        if any(not 1 <= start < version for start in migrations):
            message = (
                f"cannot keep {name}: migrations start from versions {sorted(migrations)}, which are not all before {version}"
            )
            raise SchemaError(f"{message}; a migration is filed under the version that it reads", name)
        description = describe(kind)
        fingerprint = blake3(f"{FORMAT}\n{version}\n{description}".encode(errors="surrogatepass")).digest(length=FINGERPRINT_SIZE)
        encode = msgspec.msgpack.Encoder().encode
        prefix = b"\x94" + b"".join(map(encode, (FORMAT, version, fingerprint)))
        place = root_place(name)
        return cls(
            name, version, fingerprint, description, kind, place, prefix, default, dict(migrations), compiler.open(), encode
        )

    def fresh(self) -> Any:
        """The first value: a copy of the default.

        Raises:
            SchemaError: there is none.
        """
        if self._default is None:
            raise SchemaError(f"{self.name} has no default to start from; declare one", self.name)
        return self._default()

    def encode(self, value: Any) -> Encoded:
        """The bytes of a value.

        Raises:
            KeepError: something in it cannot be kept as declared; names the place. Nothing changed.
        """
        walk = Walk(INLINE_SIZE_MAX)
        try:
            packed = self._prefix + self._encode(self._kind.lower(value, walk, self._place))
        except RecursionError as error:
            raise KeepError(
                f"cannot keep {self.name}: nested too deep for this stack; keep a flat list and indices", self.name
            ) from error
        except RuntimeError as error:  # "dictionary changed size during iteration"
            message = f"cannot keep {self.name}: another thread changes it meanwhile ({error})"
            raise KeepError(f"{message}; commit in the thread that changes it, or hold its lock", self.name) from error
        if len(packed) > DATA_SIZE_MAX:
            refuse_size(len(packed), self.name)
        return Encoded(packed, tuple(walk.regions))

    def decode(self, encoded: Encoded, allocate: Allocate | None = None) -> Decoded:
        """The value of bytes, from any writer.

        Args:
            encoded: a region's memory may be longer than was stored.
            allocate: makes the arrays; ``numpy.empty`` unless given.

        Raises:
            StateFormatError: not a whole state of ours.
            FitError: it does not fit the declaration; names the field. Nothing was lost: it is still stored.
        """
        stored = read(encoded.data, self.name)
        regions = _regions(encoded.regions, self.name)
        try:
            migrated, regions, shared, notes = self._migrated(stored, regions)
            build = Build(regions, allocate or _allocate, shared)
            value = self._kind.lift(migrated, build, self._place)
        except RecursionError as error:
            raise FitError(f"{self.name}: nested too deep for this stack", self.name) from error
        except MemoryError as error:
            raise FitError(f"{self.name}: there is not enough memory to read it", self.name) from error
        return Decoded(value, (*notes, *build.notes.values()), stored.version)

    def _migrated(self, stored: Stored, regions: dict[str, memoryview]) -> tuple[Wire, dict[str, memoryview], bool, list[str]]:
        """The state in the form of this version, its regions, whether it is shared, and the notes.

        Raises:
            FitError: it is newer, or a migration is missing or failed.
        """
        if stored.version > self.version:
            message = f"{self.name}: stored by version {stored.version} of its declaration, this program has {self.version}"
            raise FitError(
                f"{message}; run the newer program, or write down the way back as a migration of a still higher version",
                self.name,
            )
        steps = [start for start in range(stored.version, self.version) if start in self._migrations]
        if not steps:
            return stored.wire, regions, stored.shared, []
        value = self._open.lift(stored.wire, Build(regions, _allocate, stored.shared), self._place)
        for start in steps:
            value = self._step(start, value)
        walk = Walk(INLINE_SIZE_MAX)
        try:
            wire = self._open.lower(value, walk, self._place)
        except KeepError as error:
            raise FitError(f"{self.name}: cannot store the result of its migration: {error}", error.place) from error
        notes = [f"{self.name}: migrated from version {stored.version} to {self.version}"]
        return wire, {region.name: region.memory for region in walk.regions}, True, notes

    def _step(self, start: int, value: Any) -> Any:
        """The value of the next version.

        Raises:
            FitError: the program's migration failed.
        """
        try:
            return self._migrations[start](value)
        except Exception as error:
            message = f"{self.name}: its migration from version {start} failed: {type(error).__name__}: {error}"
            raise FitError(f"{message}; mend it, the state is still stored", self.name) from error


def _endless(name: str) -> SchemaError:
    """The refusal of a type alias that contains itself."""
    return SchemaError(
        f"cannot keep {name}: a type in it is made of itself without end; put a class between, or declare Any", name
    )


def read(data: bytes | memoryview, name: str = "state") -> Stored:
    """Read how the bytes of a state describe themselves.

    Raises:
        StateFormatError: cut off, damaged, of another format, or in another spelling than ours.
    """
    if len(data) > DATA_SIZE_MAX:
        raise StateFormatError(f"{name}: {len(data)} bytes are more than {DATA_SIZE_MAX}", name)
    try:
        parts = msgspec.msgpack.decode(data)
        again = msgspec.msgpack.encode(parts)
    except (msgspec.MsgspecError, UnicodeError, OverflowError, TypeError, ValueError, RecursionError) as error:
        raise StateFormatError(f"{name}: not a whole state: {error}", name) from error
    if type(parts) is not list or len(parts) != 4 or parts[0] != FORMAT:
        found = f"{parts[0]!r}"[:60] if type(parts) is list and parts else type(parts).__name__
        raise StateFormatError(f"{name}: not a state of format {FORMAT!r} (it begins with {found})", name)
    if again != data:
        raise StateFormatError(f"{name}: damaged: doubled keys, or another spelling than ours", name)
    _, version, fingerprint, wire = parts
    if (
        type(version) is not int
        or not 1 <= version <= VERSION_MAX
        or type(fingerprint) is not bytes
        or len(fingerprint) != FINGERPRINT_SIZE
    ):
        raise StateFormatError(f"{name}: damaged: its version or its fingerprint cannot be", name)
    return Stored(version, fingerprint, wire, _PACKED_SAME in bytes(data))


def _regions(regions: tuple[Region, ...], name: str) -> dict[str, memoryview]:
    if len(regions) > REGION_COUNT_MAX:
        raise StateFormatError(f"{name}: {len(regions)} regions are more than {REGION_COUNT_MAX}", name)
    named = {region.name: region.memory for region in regions}
    if len(named) != len(regions):
        raise StateFormatError(f"{name}: two regions have the same name", name)
    return named


def _allocate(name: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> np.ndarray[Any, Any]:
    return np.empty(shape, dtype)


def _fresh_fields(fields: tuple[RecordField, ...], name: str) -> dict[str, Any]:
    """Every field's default.

    Raises:
        SchemaError: one has none.
    """
    missing = [field.name for field in fields if field.default is None]
    if missing:
        raise SchemaError(f"{name}.{missing[0]} has no default to start from; declare one", f"{name}.{missing[0]}")
    return {field.name: field.default() for field in fields if field.default is not None}


def describe(kind: Kind) -> str:
    """A declaration in words: the kind, and every kind in it that has more to say than its name."""
    found: dict[Kind, str] = {}
    waiting = [kind]
    while waiting:
        at = waiting.pop()
        if at not in found:
            found[at] = at.description()
            waiting.extend(reversed(at.parts()))
    said = [text for at, text in found.items() if at is kind or text != at.name]
    return "\n".join(dict.fromkeys(said))


__all__ = ["Decoded", "Encoded", "Schema", "StateError", "Stored", "describe", "read"]
