"""A snapshot file holds exactly what was written, or is refused."""

from __future__ import annotations

import os
import random
import threading
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from checkpoint.errors import FormatError
from checkpoint.model import OutputPiece, PageRun, Resource, Snapshot, Vma
from checkpoint.pages.page_set import Mappings
from checkpoint.snapshot import canonical_state, format, layout, validity
from checkpoint.snapshot.frames import Packer
from tests.checkpoint.snapshots import PAGE, START, family, history, page, snapshot, vma

FACTS = st.recursive(
    st.none() | st.booleans() | st.integers(-(1 << 63), (1 << 64) - 1) | st.text(max_size=8) | st.binary(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=6,
)
CONTENTS = st.one_of(
    st.just(bytes(PAGE)),
    st.integers(0, 255).map(lambda byte: bytes([byte]) * PAGE),
    st.randoms().map(lambda dice: dice.randbytes(PAGE)),
)


@st.composite
def snapshots(draw: st.DrawFn) -> Snapshot:
    """Any snapshot that a capture could make of a small process."""
    state = draw(st.dictionaries(st.integers(0, 63), CONTENTS, max_size=8))
    made = snapshot(state, sequence=draw(st.integers(2, 1 << 40)), component=draw(st.text(min_size=1, max_size=20)))
    facts = draw(st.dictionaries(st.text(max_size=6), FACTS, max_size=3))
    pieces = (OutputPiece(1, draw(st.integers(0, 1 << 40)), draw(st.binary(max_size=50))),)
    return replace(
        made,
        resources=(Resource("files", "fd 3", facts),),
        output=pieces,
        notes=tuple(draw(st.lists(st.text(max_size=10), max_size=2))),
        epoch=draw(st.integers(0, 1 << 62)),
        cleared=() if draw(st.booleans()) else (PageRun(START, START + PAGE),),
    )


def test_what_compresses_is_compressed_behind_what_does_not() -> None:
    """Memory of slots that each begin with noise: no sample at a fixed place tells of the rest."""
    dice = random.Random(1)
    noise = memoryview(dice.randbytes(layout.FRAME_SIZE))
    slots = layout.FRAME_SIZE >> 18
    mixed = memoryview(b"".join(dice.randbytes(16 << 10) + bytes(240 << 10) for _ in range(slots)))
    packer = Packer(1)
    bodies = [packer(raw) for raw in (noise, mixed, noise, mixed)]
    assert [body.codec for body in bodies] == [layout.Codec.RAW, layout.Codec.ZSTD] * 2
    assert all(body.digest == layout.digest_of(body.content) for body in bodies)


@settings(max_examples=150, deadline=None)
@given(snapshots())
def test_what_was_written_is_what_is_read(made: Snapshot) -> None:
    content = format.encode_bytes(made)
    assert format.decode(content) == made
    assert format.encode_bytes(made) == content
    outline = format.read_outline(content)
    assert replace(outline, contents=made.contents) == made
    assert format.verify(content) == format.read_header(content)
    assert format.verified(content)[1] == outline
    assert format.read_header(content).position == made.position


def test_what_two_snapshots_tell_in_the_same_bytes_is_decoded_once() -> None:
    first = snapshot({0: page("a")}, vmas=(vma(0, 7),))
    other = snapshot({0: page("b")}, sequence=2, vmas=(vma(0, 7),), component="another")
    read = [format.read_outline(format.encode_bytes(one)) for one in (first, other)]
    for name in ("machine", "process", "vmas", "resources"):
        assert getattr(read[0], name) is getattr(read[1], name)
        assert getattr(read[1], name) == getattr(other, name)
    wider = format.read_outline(format.encode_bytes(snapshot({0: page("a")}, vmas=(vma(0, 8),))))
    assert wider.vmas == (vma(0, 8),)
    assert wider.vmas != read[0].vmas


def test_a_part_that_was_refused_is_refused_again() -> None:
    """Keys out of order, which only a changed program writes."""
    made = snapshot({0: page("a")})
    packed = canonical_state.encode_state(replace(made, resources=(Resource("files", "fd 3", {"a": 1, "b": 2}),)))
    wrong = packed.replace(b"\xa1a\x01\xa1b\x02", b"\xa1b\x02\xa1a\x01")
    assert wrong != packed
    for _ in range(2):
        with pytest.raises(FormatError, match="facts of files 'fd 3': not in canonical form"):
            canonical_state.decode_state(wrong)


def test_sections_of_a_known_file_are_not_read_again_and_its_pages_are() -> None:
    content = format.encode_bytes(snapshot({0: page("a"), 1: page("b")}))
    known = format.verified(content)
    altered = bytearray(content)
    state = known[0].sections[layout.SectionKind.STATE - 1]
    altered[state.offset + 3] ^= 1
    assert format.decode(bytes(altered), known=known) == format.decode(content)
    with pytest.raises(FormatError, match="section state"):
        format.decode(bytes(altered))
    altered[known[0].frames_offset + layout.FRAME_HEAD_SIZE] ^= 1
    with pytest.raises(FormatError, match="its body does not match"):
        format.decode(bytes(altered), known=known)
    other = format.encode_bytes(snapshot({0: page("c")}))
    assert format.decode(other, known=known) == format.decode(other)


def test_a_file_of_several_frames_is_read_from_a_path_a_descriptor_and_memory(tmp_path: Path) -> None:
    dice = random.Random(5)
    state = {number: dice.randbytes(PAGE) if number % 3 else page(str(number)) for number in range(700)}
    made = snapshot(state, vmas=(vma(0, 700),))
    path = tmp_path / "snapshot"
    with path.open("wb") as file:
        size = format.encode(made, file)
    assert size == path.stat().st_size
    descriptor = os.open(path, os.O_RDONLY)
    try:
        assert format.decode(path) == format.decode(descriptor) == format.decode(path.read_bytes()) == made
    finally:
        os.close(descriptor)


def large(frames: int = 12) -> Snapshot:
    """One of so many frames, of which each other one compresses."""
    dice, per_frame = random.Random(6), layout.FRAME_SIZE // PAGE
    count = frames * per_frame - 3
    return snapshot(
        {n: dice.randbytes(PAGE) if n // per_frame % 2 else bytes([n % 251]) * PAGE for n in range(count)}, vmas=(vma(0, count),)
    )


def test_several_threads_write_and_read_the_very_same_bytes(tmp_path: Path) -> None:
    made = large()
    alone = format.encode_bytes(made)
    with (tmp_path / "snapshot").open("wb", buffering=0) as file:
        assert format.encode(made, file, threads=3) == len(alone)
    assert (tmp_path / "snapshot").read_bytes() == alone
    assert format.decode(tmp_path / "snapshot", threads=3) == format.decode(alone) == made


def test_several_threads_find_the_damage_that_one_finds(tmp_path: Path) -> None:
    whole = format.encode_bytes(large())
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    for damaged in (bytes(flipped), whole[: len(whole) // 2], whole[:-1], whole + b"x"):
        said = []
        for threads in (1, 3):
            with pytest.raises(FormatError) as refused:
                format.decode(damaged, threads=threads)
            said.append(str(refused.value))
        assert said[0] == said[1]


def test_a_file_that_takes_nothing_more_ends_the_threads_that_write_it() -> None:
    before = threading.active_count()
    with pytest.raises(OSError, match="takes nothing more"):
        format.encode(large(), FullSink(5 << 20), threads=3)
    assert threading.active_count() == before


@pytest.fixture(scope="module")
def sample() -> bytes:
    return format.encode_bytes(history(2)[1])


def test_one_flipped_bit_anywhere_is_refused(sample: bytes) -> None:
    altered = bytearray(sample)
    for place in range(len(sample)):
        for bit in range(8) if place < 2 * layout.PREAMBLE_SIZE else (place % 8,):
            altered[place] ^= 1 << bit
            with pytest.raises(FormatError):
                format.decode(bytes(altered))
            altered[place] ^= 1 << bit
    assert bytes(altered) == sample


def test_a_file_that_ends_anywhere_too_early_is_refused(sample: bytes) -> None:
    for size in range(len(sample)):
        with pytest.raises(FormatError):
            format.decode(sample[:size])


def test_a_file_that_something_follows_is_refused(sample: bytes) -> None:
    with pytest.raises(FormatError, match="follow"):
        format.decode(sample + b"\0")


def test_another_version_is_named(sample: bytes) -> None:
    altered = bytearray(sample)
    altered[8] = 9
    with pytest.raises(FormatError, match="version 9"):
        format.decode(bytes(altered))


@pytest.mark.parametrize("content", [b"", b"hello, world\n" * 100, bytes(5000)])
def test_what_is_no_snapshot_is_said_so(content: bytes) -> None:
    with pytest.raises(FormatError, match="not a snapshot"):
        format.decode(content)


def with_guards(made: Snapshot, first: int, count: int) -> Snapshot:
    guards = (PageRun(START + first * PAGE, START + (first + count) * PAGE),)
    return replace(made, vmas=(replace(made.vmas[0], guards=guards),))


BROKEN = {
    "page size": lambda made: replace(made, machine=replace(made.machine, page_size=5000)),
    "overlaps": lambda made: replace(made, vmas=made.vmas * 2),
    "lies in no mapping": lambda made: replace(made, runs=(PageRun(PAGE, 5 * PAGE),)),
    "not all inside": lambda made: with_guards(made, 200, 1),
    "is carried, too": lambda made: with_guards(made, 3, 2),
    "where the runs need": lambda made: replace(made, contents=made.contents[:-1]),
    "page sum": lambda made: replace(made, page_sum=b""),
    "same id": lambda made: replace(made, threads=made.threads * 2),
    "the first is": lambda made: replace(made, threads=(replace(made.threads[0], tid=99), *made.threads[1:])),
    "is not before": lambda made: replace(made, parent=replace(made.position, sequence=99)),
    "cannot be": lambda made: replace(made, output=(OutputPiece(3, 0, b""),)),
    "epoch": lambda made: replace(made, epoch=-1),
}


@pytest.mark.parametrize("kind", [tuple, Mappings])
@pytest.mark.parametrize("words", [*BROKEN])
def test_a_snapshot_that_does_not_hold_together_is_not_written(words: str, kind: type[tuple[Vma, ...]]) -> None:
    made = BROKEN[words](snapshot({n: page("x") for n in range(4)}))
    made = replace(made, vmas=kind(made.vmas))
    for _ in range(2):  # mappings that were refused once are no better the second time
        with pytest.raises(FormatError, match=words):
            format.encode_bytes(made)


def with_child(made: Snapshot, **changes: object) -> Snapshot:
    child = made.members[0]
    return replace(made, members=(replace(child, **changes),))


BROKEN_FAMILIES = {
    "there are none": lambda made: with_child(made, threads=()),
    "none of them": lambda made: with_child(made, process=replace(made.members[0].process, ppid=77)),
    "ancestor of its own": lambda made: replace(
        made,
        members=(
            replace(made.members[0], process=replace(made.members[0].process, ppid=5)),
            replace(
                made.members[0],
                slot=2,
                process=replace(made.members[0].process, pid=5, ppid=3),
                threads=(replace(made.members[0].threads[0], tid=5),),
            ),
        ),
    ),
}


@pytest.mark.parametrize("words", [*BROKEN_FAMILIES])
def test_a_family_that_does_not_hold_together_is_not_written(words: str) -> None:
    with pytest.raises(FormatError, match=words):
        format.encode_bytes(BROKEN_FAMILIES[words](family(1)[0]))


class FullSink:
    """A file that takes so many bytes, and then nothing, and says no reason."""

    def __init__(self, room: int = 0) -> None:
        self._room = room

    def write(self, content: bytes | memoryview, /) -> int:
        taken = min(len(content), self._room)
        self._room -= taken
        return taken


def test_a_file_that_takes_nothing_more_is_an_error_and_no_endless_loop() -> None:
    with pytest.raises(OSError, match="takes nothing more"):
        format.encode(history(1)[0], FullSink())


def test_a_file_that_expands_to_more_than_the_limit_is_refused_before_a_page_is_copied(monkeypatch: pytest.MonkeyPatch) -> None:
    (base,) = family(1)
    size = len(base.contents) + sum(copy.size for copy in base.copies)
    encoded = format.encode_bytes(base)
    monkeypatch.setattr(validity, "MAX_CONTENTS_SIZE", size)
    assert format.decode(encoded).copies
    monkeypatch.setattr(validity, "MAX_CONTENTS_SIZE", size - PAGE)
    with pytest.raises(FormatError, match=f"copies: {size} bytes with their sources, above the limit of {size - PAGE}"):
        format.decode(encoded)
