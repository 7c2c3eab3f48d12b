"""Lines of the log as the journal gets them: with fields, whole, and without a wait."""

from __future__ import annotations

import contextlib
import logging
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from agent.system import journal
from agent.system.journal import Journal

NAME = "/lab/robot1/mapper"


@pytest.fixture
def place(tmp_path: Path) -> Iterator[tuple[socket.socket, Journal]]:
    """A socket as journald has one, and what sends to it."""
    path = str(tmp_path / "socket")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(path)
        handler = Journal("robot1", path)
        yield listener, handler
        handler.close()


def entry(content: bytes) -> dict[str, str]:
    """One entry, read as journald reads it."""
    fields = {}
    while content:
        line, _, content = content.partition(b"\n")
        name, has_value, value = line.partition(b"=")
        if not has_value:
            size = int.from_bytes(content[:8], "little")
            value, content = content[8 : 8 + size], content[8 + size + 1 :]
        fields[name.decode()] = value.decode()
    return fields


def record(message: str, *arguments: object, level: int = logging.INFO, **extra: object) -> logging.LogRecord:
    return logging.getLogger("failover.test").makeRecord("failover.test", level, "", 0, message, arguments, None, extra=extra)


def test_a_line_is_an_entry_that_names_robot_component_and_epoch(place: tuple[socket.socket, Journal]) -> None:
    listener, handler = place
    handler.emit(record("%s: %s", NAME, "it resumes", epoch=7))
    assert entry(listener.recv(1 << 16)) == {
        "MESSAGE": f"{NAME}: it resumes",
        "PRIORITY": "6",
        "SYSLOG_IDENTIFIER": "failover-agent",
        "ROBOT": "robot1",
        "LOGGER": "failover.test",
        "COMPONENT": NAME,
        "EPOCH": "7",
    }
    handler.emit(record("%s: %s", "robot2", "it is silent", component="", level=logging.WARNING))
    about_the_robot = entry(listener.recv(1 << 16))
    assert "COMPONENT" not in about_the_robot and "EPOCH" not in about_the_robot and about_the_robot["PRIORITY"] == "4"


@pytest.mark.parametrize("message", ["two\nlines", "a=b", "COMPONENT=/lab/other", "x\nCOMPONENT=/lab/other\ny", "☃ \ud800", "\n"])
def test_whatever_a_line_holds_it_is_one_field(place: tuple[socket.socket, Journal], message: str) -> None:
    listener, handler = place
    handler.emit(record("%s", message))
    got = entry(listener.recv(1 << 16))
    assert got["MESSAGE"] == message.encode(errors="backslashreplace").decode()
    assert "COMPONENT" not in got


def test_a_journal_that_takes_nothing_is_not_waited_for_and_is_told_how_much_it_missed(
    place: tuple[socket.socket, Journal],
) -> None:
    listener, handler = place
    for number in range(2_000):  # more than a socket holds; a sender that waited would never come back
        handler.emit(record("line %d", number))
    listener.setblocking(False)
    got = []
    with contextlib.suppress(BlockingIOError):
        while True:
            got.append(entry(listener.recv(1 << 16))["MESSAGE"])
    lost = 2_000 - len(got)
    assert lost > 0 and got == [f"line {number}" for number in range(len(got))]
    handler.emit(record("after"))
    assert entry(listener.recv(1 << 16))["MESSAGE"].startswith(f"{lost} lines of this log are lost")
    assert entry(listener.recv(1 << 16))["MESSAGE"] == "after"


def test_a_stream_that_is_not_the_journals_gets_plain_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(journal.STREAM, "1:1")
    assert not journal.is_ours()
    monkeypatch.delenv(journal.STREAM)
    assert not journal.is_ours()
