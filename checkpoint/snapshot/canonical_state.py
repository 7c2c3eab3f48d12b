"""Encode the state of a snapshot besides its pages as canonical bytes: the same state always gives the same bytes.

The header is the part that a listing needs; the state is the part that a restore needs and that the state digest covers. Both are
msgpack maps in field order with sorted dictionary keys. A reader encodes again what it decoded and refuses bytes that differ, so
unknown fields, doubled keys and other encodings of the same value do not pass.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from itertools import pairwise
from typing import Any, Final, TypeVar

import msgspec
from blake3 import blake3
from msgspec.structs import replace

from checkpoint.errors import FormatError
from checkpoint.model import (
    Clocks,
    Machine,
    Member,
    OutputPiece,
    Position,
    ProcessState,
    Resource,
    Snapshot,
    ThreadState,
    Vma,
    Zombie,
)
from checkpoint.pages.page_set import Mappings
from checkpoint.snapshot.process_tree import every_mapping

_Value = TypeVar("_Value")

STATE_DIGEST_SIZE = 16
"""Bytes of a position's digest."""

MAX_FACT_DEPTH = 8
"""How deep the facts of a resource may be nested."""

PLAIN = frozenset((type(None), bool, int, float, str, bytes))
"""Types of facts that hold no others."""

OUT_OF_ORDER = "not in canonical form (keys out of order)"

PARTS_KEPT: Final = 32
PART_SIZE: Final = 64 << 10
"""Parts of states that stay decoded, and the most bytes of one: a few components' deltas, which tell the same of most things."""


class Header(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The facts of a snapshot that a listing shows. Fields are those of ``Snapshot``; counts are of its lists.

    Attributes:
        contents_size: bytes of page contents before compression.
        output_size: bytes of stream output that it carries.
    """

    component: str
    engine: str
    epoch: int
    position: Position
    parent: Position | None
    machine: Machine
    page_sum: bytes
    contents_size: int
    run_count: int
    cleared_count: int
    vma_count: int
    thread_count: int
    output_size: int
    freeze_us: int
    notes: tuple[str, ...]

    @property
    def is_base(self) -> bool:
        """Whether it stands alone."""
        return self.parent is None


class _ResourceRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A ``Resource``; its facts are of a type that msgspec cannot name."""

    kind: str
    name: str
    facts: dict[str, Any]


class _State(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Everything that a restore needs besides the pages."""

    component: str
    engine: str
    epoch: int
    machine: Machine
    clocks: Clocks
    process: ProcessState
    threads: tuple[ThreadState, ...]
    vmas: tuple[Vma, ...]
    resources: tuple[_ResourceRecord, ...]


class _MemberRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A ``Member``; see `_ResourceRecord`."""

    slot: int
    exit_signal: int
    process: ProcessState
    threads: tuple[ThreadState, ...]
    vmas: tuple[Vma, ...]
    resources: tuple[_ResourceRecord, ...]


class _TreeState(_State, frozen=True, forbid_unknown_fields=True):
    """The same of several processes: what version 2 holds."""

    members: tuple[_MemberRecord, ...]
    zombies: tuple[Zombie, ...]


class _PackedState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A ``_State`` of which those parts are not decoded that are often the same as of the snapshot before."""

    component: str
    engine: str
    epoch: int
    machine: msgspec.Raw
    clocks: Clocks
    process: msgspec.Raw
    threads: tuple[ThreadState, ...]
    vmas: msgspec.Raw
    resources: msgspec.Raw


class _PackedTree(_PackedState, frozen=True, forbid_unknown_fields=True):
    """The same of a ``_TreeState``."""

    members: tuple[_MemberRecord, ...]
    zombies: tuple[Zombie, ...]


class State(msgspec.Struct, frozen=True):
    """The decoded state section: the fields of ``Snapshot`` with the same names. Parts decoded before are the same objects."""

    component: str
    engine: str
    epoch: int
    machine: Machine
    clocks: Clocks
    process: ProcessState
    threads: tuple[ThreadState, ...]
    vmas: Mappings
    resources: tuple[Resource, ...]
    members: tuple[Member, ...] = ()
    zombies: tuple[Zombie, ...] = ()


def header_of(snapshot: Snapshot) -> Header:
    """The header that describes a snapshot."""
    return Header(
        component=snapshot.component,
        engine=snapshot.engine,
        epoch=snapshot.epoch,
        position=snapshot.position,
        parent=snapshot.parent,
        machine=snapshot.machine,
        page_sum=snapshot.page_sum,
        contents_size=sum(run.size for run in snapshot.runs),
        run_count=len(snapshot.runs),
        cleared_count=len(snapshot.cleared),
        vma_count=len(every_mapping(snapshot)),
        thread_count=len(snapshot.threads) + sum(len(member.threads) for member in snapshot.members),
        output_size=sum(len(piece.content) for piece in snapshot.output),
        freeze_us=snapshot.freeze_us,
        notes=snapshot.notes,
    )


def encode_header(header: Header) -> bytes:
    """Canonical bytes of a header."""
    return _encoded(header, "header")


def decode_header(packed: bytes | memoryview) -> Header:
    """The header in these bytes.

    Raises:
        FormatError: not a header, or not in canonical form.
    """
    return _decoded(packed, Header, "header")


def encode_state(snapshot: Snapshot) -> bytes:
    """Canonical bytes of everything that a restore needs besides the pages.

    Raises:
        FormatError: a value has no place in msgpack (text that is not UTF-8, an integer beyond 64 bits).
    """
    state = _State(
        component=snapshot.component,
        engine=snapshot.engine,
        epoch=snapshot.epoch,
        machine=snapshot.machine,
        clocks=snapshot.clocks,
        process=_canonical_process(snapshot.process),
        threads=_canonical_threads(snapshot.threads),
        vmas=snapshot.vmas,
        resources=_records(snapshot.resources),
    )
    if snapshot.is_tree:
        members = tuple(map(_member_record, snapshot.members))
        state = _TreeState(**msgspec.structs.asdict(state), members=members, zombies=snapshot.zombies)
    return _encoded(state, "state")


def _member_record(member: Member) -> _MemberRecord:
    return _MemberRecord(
        slot=member.slot,
        exit_signal=member.exit_signal,
        process=_canonical_process(member.process),
        threads=_canonical_threads(member.threads),
        vmas=member.vmas,
        resources=_records(member.resources),
    )


def _canonical_process(process: ProcessState) -> ProcessState:
    return replace(process, limits=_sorted(process.limits))


def _canonical_threads(threads: tuple[ThreadState, ...]) -> tuple[ThreadState, ...]:
    return tuple(replace(thread, registers=_sorted(thread.registers)) for thread in threads)


def _records(resources: tuple[Resource, ...]) -> tuple[_ResourceRecord, ...]:
    return tuple(_ResourceRecord(held.kind, held.name, _sorted(held.facts)) for held in resources)


def decode_state(packed: bytes | memoryview, *, is_tree: bool = False) -> State:
    """The state in these bytes.

    Args:
        is_tree: of several processes.

    Raises:
        FormatError: not a state, or not in canonical form; names the field.
    """
    state: _PackedState = _decoded(packed, _PackedTree if is_tree else _PackedState, "state")
    members = state.members if isinstance(state, _PackedTree) else ()
    _check_registers(state.threads)
    for record in members:
        _check_registers(record.threads)
        _check_process(record.process)
        _check_facts(record.resources)
    return State(
        component=state.component,
        engine=state.engine,
        epoch=state.epoch,
        machine=_part(_machine, state.machine),
        clocks=state.clocks,
        process=_part(_process, state.process),
        threads=state.threads,
        vmas=_part(_mappings, state.vmas),
        resources=_part(_facts, state.resources),
        members=tuple(map(_member, members)),
        zombies=state.zombies if isinstance(state, _PackedTree) else (),
    )


def _part(read: Callable[[bytes], _Value], packed: msgspec.Raw) -> _Value:
    """A part of a state: the same object as before, where it is the same bytes."""
    content = bytes(packed)
    found: _Value = _kept(read, content) if len(content) <= PART_SIZE else read(content)
    return found


@lru_cache(PARTS_KEPT)
def _kept(read: Callable[[bytes], Any], packed: bytes) -> Any:
    return read(packed)


def _machine(packed: bytes) -> Machine:
    return _decoded(packed, Machine, "state: machine")


def _process(packed: bytes) -> ProcessState:
    process = _decoded(packed, ProcessState, "state: process")
    _check_process(process)
    return process


def _mappings(packed: bytes) -> Mappings:
    return Mappings(_decoded(packed, tuple[Vma, ...], "state: vmas"))


def _facts(packed: bytes) -> tuple[Resource, ...]:
    records = _decoded(packed, tuple[_ResourceRecord, ...], "state: resources")
    _check_facts(records)
    return _resources(records)


def _check_process(process: ProcessState) -> None:
    if not _is_sorted(process.limits):
        raise FormatError(f"state: {OUT_OF_ORDER}")


def _check_registers(threads: tuple[ThreadState, ...]) -> None:
    if not all(_is_sorted(thread.registers) for thread in threads):
        raise FormatError(f"state: {OUT_OF_ORDER}")


def _check_facts(records: tuple[_ResourceRecord, ...]) -> None:
    """Refuse facts that cannot be, and keys that are out of order."""
    for record in records:
        try:
            _check_fact(record.facts, MAX_FACT_DEPTH)
        except FormatError as error:
            raise FormatError(f"state: facts of {record.kind} {record.name!r}: {error}") from None


def _resources(records: tuple[_ResourceRecord, ...]) -> tuple[Resource, ...]:
    return tuple(Resource(record.kind, record.name, record.facts) for record in records)


def _member(record: _MemberRecord) -> Member:
    return Member(
        slot=record.slot,
        exit_signal=record.exit_signal,
        process=record.process,
        threads=record.threads,
        vmas=record.vmas,
        resources=_resources(record.resources),
    )


def encode_output(output: tuple[OutputPiece, ...]) -> bytes:
    """Canonical bytes of the pieces of stream output."""
    return _encoded(output, "output")


def decode_output(packed: bytes | memoryview) -> tuple[OutputPiece, ...]:
    """The pieces of output in these bytes.

    Raises:
        FormatError: not pieces of output, or not in canonical form.
    """
    return _decoded(packed, tuple[OutputPiece, ...], "output")


def state_digest(snapshot: Snapshot) -> bytes:
    """The digest that a position must have: the first 16 bytes of blake3(page sum ‖ blake3(state bytes))."""
    return digest_of_state(snapshot.page_sum, encode_state(snapshot))


def digest_of_state(page_sum: bytes, packed: bytes | memoryview) -> bytes:
    """The same, of a state that is encoded already."""
    return blake3(page_sum + blake3(packed).digest()).digest(length=STATE_DIGEST_SIZE)


def _encoded(value: object, what: str) -> bytes:
    try:
        return msgspec.msgpack.encode(value)
    except (UnicodeEncodeError, OverflowError, TypeError, RecursionError) as error:
        raise FormatError(f"cannot encode the {what} of a snapshot: {error}") from error


def _sorted(value: Any) -> Any:
    """The same value with the keys of every mapping in order."""
    if isinstance(value, Mapping):
        inner = [(key, value[key]) for key in sorted(value)]
        return {key: one if type(one) in PLAIN else _sorted(one) for key, one in inner}
    if isinstance(value, list | tuple):
        return [one if type(one) in PLAIN else _sorted(one) for one in value]
    return value


def _is_sorted(value: Mapping[Any, object]) -> bool:
    """Whether the keys of a mapping are in order."""
    return all(earlier < later for earlier, later in pairwise(value))


def _decoded(packed: bytes | memoryview, kind: type[_Value], what: str) -> _Value:
    try:
        value = msgspec.msgpack.decode(packed, type=kind)
        again = msgspec.msgpack.encode(value)
    except (msgspec.MsgspecError, UnicodeError, OverflowError, TypeError, ValueError, RecursionError) as error:
        raise FormatError(f"{what}: {error}") from error
    if again != packed:
        raise FormatError(f"{what}: not in canonical form (unknown or doubled keys, or another spelling of a value)")
    return value


def _check_fact(fact: object, depth: int) -> None:
    """Refuse what a fact cannot be: extension types, keys that are not text, or not in order, endless nesting.

    Args:
        depth: how deep it may be nested yet; a value that holds no other is not looked at by itself.
    """
    if depth == 0:
        raise FormatError(f"nested deeper than {MAX_FACT_DEPTH}")
    inner: Iterable[object] = ()
    if type(fact) is dict:
        if not all(type(key) is str for key in fact):
            raise FormatError("a key is not text")
        if not _is_sorted(fact):
            raise FormatError(OUT_OF_ORDER)
        inner = fact.values()
    elif type(fact) is list:
        inner = fact
    elif type(fact) not in PLAIN:
        raise FormatError(f"{type(fact).__name__} is not a type of fact")
    for one in inner:
        if depth == 1 or type(one) not in PLAIN:
            _check_fact(one, depth - 1)
