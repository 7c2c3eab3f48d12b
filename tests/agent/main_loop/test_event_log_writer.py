"""The event log on disk: written lines survive, a torn end is skipped, the size is bounded, and no caller waits for the disk."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec.structs import replace

from agent import event_log
from agent.event_log import EventLogFile, packed, read, unpacked
from agent.main_loop import event_log_writer
from agent.main_loop.event_log_writer import REPEAT_NS, WAITING_MAX, EventLogWriter
from failover.core.event_log.decisions import SAID, Decision, Facts, Line, Sighting

PATIENCE_S = 20.0
POLL_S = 0.005


def line(number: int, sentence: str = "it happened", life: int = 1) -> Line:
    seen = (Sighting("robot2", "dead", 4, 17, 230_000_000, 220_000_000, (("wire", 230_000_000),), False, "primary"),)
    return Line("robot1", life, number, "kernel", 10**18, Decision(number, "/lab/x", sentence, Facts(3, 1, 2, seen=seen)))


def sentences(directory: Path) -> list[str]:
    return [one.decision.sentence for one in read(directory).lines]


def until(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        time.sleep(POLL_S)


def test_a_line_survives_its_bytes() -> None:
    assert unpacked(packed(line(1))[:-1]) == line(1)


def test_lines_survive_the_end_of_their_writer_and_the_next_goes_on_after_them(tmp_path: Path) -> None:
    for life in (1, 2):
        file = EventLogFile(tmp_path)
        file.append([line(1, f"life {life}", life)])
        file.close()
    assert sentences(tmp_path) == ["life 1", "life 2"]


def test_wherever_a_power_cut_tears_the_end_the_lines_before_it_and_after_it_are_read(tmp_path: Path) -> None:
    whole = packed(line(1, "first")) + packed(line(2, "second"))
    path = tmp_path / event_log.DIRECTORY / event_log.NEWER
    for size in [*range(len(packed(line(1, "first"))), len(whole) - 2, 7), len(whole) - 2, len(whole) - 1]:
        path.unlink(missing_ok=True)
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(whole[:size])
        file = EventLogFile(tmp_path)
        file.append([line(1, "after", 2)])
        file.close()
        kept = read(tmp_path)
        expected = ["first", "after"] if size < len(whole) - 1 else ["first", "second", "after"]
        assert [one.decision.sentence for one in kept.lines] == expected, size


def test_an_altered_line_is_skipped_and_counted(tmp_path: Path) -> None:
    file = EventLogFile(tmp_path)
    file.append([line(1, "first"), line(2, "second")])
    file.close()
    path = tmp_path / event_log.DIRECTORY / event_log.NEWER
    path.write_bytes(path.read_bytes().replace(b"first", b"worst"))
    assert sentences(tmp_path) == ["second"]
    assert read(tmp_path).damaged == 1


def test_the_two_halves_stay_bounded_and_hold_the_newest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(event_log, "HALF_SIZE_MAX", 4_000)
    file = EventLogFile(tmp_path)
    for number in range(1, 200):
        file.append([line(number, str(number))])
        assert sum(path.stat().st_size for path in (tmp_path / event_log.DIRECTORY).iterdir()) < 3 * 4_000
    file.close()
    kept = [int(sentence) for sentence in sentences(tmp_path)]
    assert kept == list(range(kept[0], 200)) and len(kept) > 8


def test_what_a_writer_was_told_is_read_in_order_by_the_next_life(tmp_path: Path) -> None:
    writer = EventLogWriter(tmp_path, "robot1", 7)
    for number in range(40):
        writer.note([Decision(number, "/lab/x", f"number {number}")])
    writer.close(PATIENCE_S)
    assert sentences(tmp_path) == [f"number {number}" for number in range(40)]
    assert {(one.robot, one.life) for one in read(tmp_path).lines} == {("robot1", 7)}


def test_the_agents_log_has_no_output_of_a_program(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Others than its owner read the journal; the event log is for root, and `failover why` withholds it from others."""
    with caplog.at_level("INFO"):
        writer = EventLogWriter(tmp_path, "robot1", 7)
        writer.note([Decision(1, "/lab/x", f"it ended{SAID}the password is 1234")])
        writer.close(PATIENCE_S)
    assert sentences(tmp_path) == [f"it ended{SAID}the password is 1234"]
    assert "it ended; only its owner and root may read what it said" in caplog.text and "1234" not in caplog.text


def test_a_disk_that_hangs_delays_nobody_and_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reader, waker = os.pipe()
    hangs = threading.Event()

    def hang(_descriptor: int) -> None:
        hangs.set()
        os.read(reader, 1)

    monkeypatch.setattr(os, "fdatasync", hang)
    writer = EventLogWriter(tmp_path, "robot1", 1)
    writer.note([Decision(0, "/lab/x", "the first")])
    assert hangs.wait(PATIENCE_S)
    for number in range(WAITING_MAX + 100):
        writer.note([Decision(number, "/lab/x", f"number {number}")])
    waiting = writer.unwritten()
    assert len(waiting) == WAITING_MAX and waiting[-1].decision.sentence == f"number {WAITING_MAX + 99}"
    os.write(waker, bytes(100))
    until(lambda: writer.trouble.startswith("100 decisions are missing"), "the missing ones to be said")
    writer.close(PATIENCE_S)
    os.close(waker)
    os.close(reader)


def test_a_full_disk_is_said_and_once_there_is_room_nothing_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(event_log_writer, "RETRY_S", 0.01)
    written = EventLogFile.append
    full = [True]

    def append(file: EventLogFile, lines: list[Line]) -> None:
        if full[0]:
            raise OSError(28, "No space left on device")
        written(file, lines)

    monkeypatch.setattr(EventLogFile, "append", append)
    writer = EventLogWriter(tmp_path, "robot1", 1)
    writer.note([Decision(1, "/lab/x", "a takeover")])
    until(lambda: "No space left" in writer.trouble, "the trouble to be said")
    assert [one.decision.sentence for one in writer.unwritten()] == ["a takeover"]
    full[0] = False
    until(lambda: not writer.unwritten(), "the disk to take it")
    writer.close(PATIENCE_S)
    assert sentences(tmp_path) == ["a takeover"] and writer.trouble == ""


def test_the_same_sentence_again_and_again_is_counted_and_not_written(tmp_path: Path) -> None:
    writer = EventLogWriter(tmp_path, "robot1", 1)
    same = Decision(0, "/lab/x", "a snapshot did not arrive")
    for second in range(30):
        writer.note([replace(same, at_ns=second * 10**9)])
        writer.note([Decision(second, "/lab/y", "something else about another")] if second == 3 else [])
    writer.note([replace(same, at_ns=REPEAT_NS)])
    writer.close(PATIENCE_S)
    kept = [(one.decision.component, one.repeats) for one in read(tmp_path).lines]
    assert kept == [("/lab/x", 0), ("/lab/y", 0), ("/lab/x", 29)]
