"""The cooperative engine beyond the common contract: segments that grow or are filled, states that do not fit together."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator

import pytest
from msgspec.structs import replace

from checkpoint.engine import CaptureOrder
from checkpoint.engines.cooperative.session import CooperativeSession, fill_segment, open_segment, regions_of
from checkpoint.errors import CaptureError, RestoreError
from checkpoint.model import Snapshot
from checkpoint.segment.layout import PAGE
from checkpoint.segment.reader import SegmentReader
from checkpoint.segment.writer import SegmentWriter
from checkpoint.store import chain
from tests.checkpoint.segments import Telling, committing_child, layout, number_of, number_read, source

ORDER = CaptureOrder(base=True, generation=1, sequence=1)


@pytest.fixture
def writer() -> Iterator[SegmentWriter]:
    made = SegmentWriter(layout())
    yield made
    made.close()


def session_of(writer: SegmentWriter) -> CooperativeSession:
    return CooperativeSession(SegmentReader(writer.descriptor), os.getpid(), "mission")


def base_of(number: int) -> Snapshot:
    writer, state = SegmentWriter(layout()), Telling()
    for one in range(1, number + 1):
        writer.commit(state.sources(one))
    session = session_of(writer)
    try:
        return session.capture(ORDER)
    finally:
        session.close()
        writer.close()


def test_nothing_is_captured_before_the_first_commit(writer: SegmentWriter) -> None:
    session = session_of(writer)
    with pytest.raises(CaptureError, match="committed nothing"):
        session.capture(ORDER)
    session.close()


def test_a_capture_without_a_commit_since_is_an_empty_delta(writer: SegmentWriter) -> None:
    writer.commit(Telling().sources(1))
    session = session_of(writer)
    base = session.capture(ORDER)
    session.acknowledge(base.position)
    delta = session.capture(CaptureOrder(base=False, sequence=2))
    assert delta.runs == () and chain.fold((base, delta)).contents == base.contents
    session.close()


def test_deltas_go_on_when_the_program_moves_to_a_larger_segment(writer: SegmentWriter) -> None:
    array = bytearray(b"a" * 24 * PAGE)
    writer.commit([source(b"1"), source(array)])
    session = session_of(writer)
    base = session.capture(ORDER)
    session.acknowledge(base.position)
    larger = writer.grown(layout(9 * PAGE, 24 * PAGE))
    array[5 * PAGE] = 1
    assert larger.commit([source(b"2" * 8 * PAGE), source(array)])
    writer.supersede()
    assert session.reader.is_superseded
    session.go_on_in(SegmentReader(larger.descriptor))
    delta = session.capture(CaptureOrder(base=False, sequence=2))
    assert delta.parent == base.position
    assert sum(run.size for run in delta.runs) == 9 * PAGE
    (_, state), (_, kept) = regions_of(chain.fold((base, delta)))
    assert bytes(state[: 8 * PAGE]) == b"2" * 8 * PAGE and bytes(kept) == array
    session.close()
    larger.close()


def test_a_delta_never_continues_another_lineage(writer: SegmentWriter) -> None:
    writer.commit(Telling().sources(1))
    session = session_of(writer)
    session.acknowledge(session.capture(ORDER).position)
    other = SegmentWriter(replace(layout(), lineage=bytes(16)))
    other.commit(Telling().sources(1))
    session.go_on_in(SegmentReader(other.descriptor))
    assert session.capture(CaptureOrder(base=False, sequence=2)).is_base
    session.close()
    other.close()


def test_a_segment_filled_from_a_snapshot_is_that_state_as_its_first_commit() -> None:
    filled = fill_segment(base_of(7))
    reader = SegmentReader(filled.descriptor)
    found = reader.read()
    assert found is not None and found.number == 1
    assert number_of(found.region(0), found.region(1)) == 7
    reader.close()
    filled.close()


def test_the_segment_of_a_process_is_found_and_read_after_its_death() -> None:
    with committing_child() as (pid, _):
        reader = open_segment(pid)
        found = reader.read()
        assert found is not None and number_read(found) > 0
        reader.close()


def test_a_state_that_a_program_was_handed_is_not_taken_for_what_it_commits() -> None:
    """It may be read for long, and be the only one until there is a first commit."""
    handed = fill_segment(base_of(7))
    with subprocess.Popen(["/bin/sleep", "60"], pass_fds=[handed.descriptor]) as program:  # it has no other
        try:
            assert os.readlink(f"/proc/{program.pid}/fd/{handed.descriptor}") == os.readlink(f"/proc/self/fd/{handed.descriptor}")
            with pytest.raises(CaptureError, match="no segment"):
                open_segment(program.pid)
        finally:
            program.kill()
    handed.close()


def test_a_process_without_a_segment_is_said_to_have_none() -> None:
    with subprocess.Popen(["/bin/sleep", "60"]) as other:
        try:
            with pytest.raises(CaptureError, match="no segment"):
                open_segment(other.pid)
        finally:
            other.kill()


def test_a_snapshot_of_another_engine_is_not_restored() -> None:
    with pytest.raises(RestoreError, match="of ptrace"):
        regions_of(replace(base_of(1), engine="ptrace"))


@pytest.mark.parametrize("listed", [None, [], [[1, PAGE]], [[1, PAGE], [2]], [[1, PAGE], "ab"], [[1, PAGE], [2, b""]]])
def test_a_snapshot_that_does_not_say_what_its_pages_mean_is_not_restored(listed: list[object] | None) -> None:
    whole = base_of(1)
    resource = replace(whole.resources[0], facts={**whole.resources[0].facts, "regions": listed})  # type: ignore[dict-item]
    with pytest.raises(RestoreError, match="does not describe its pages"):
        regions_of(replace(whole, resources=(resource,)))


@pytest.mark.parametrize(
    "listed", [[[1, 0], [2, 24 * PAGE]], [[9, PAGE], [2, 24 * PAGE]], [[1, PAGE], [2, 1]], [[1, -1], [2, -1]]]
)
def test_a_snapshot_whose_regions_contradict_its_pages_is_not_restored(listed: list[object]) -> None:
    whole = base_of(1)
    resource = replace(whole.resources[0], facts={**whole.resources[0].facts, "regions": listed})  # type: ignore[dict-item]
    with pytest.raises(RestoreError):
        regions_of(replace(whole, resources=(resource,)))
