"""TCP connections: those within a program come back, others end as if the peer had crashed; three restores in a row."""

from __future__ import annotations

import socket
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from checkpoint.errors import UnsupportedError
from tests.checkpoint.round_trip import (
    ENGINE,
    captured,
    captured_and_killed,
    ended,
    expect_ok,
    expect_three_lives,
    restored,
    start,
    start_tracee,
)

pytestmark = [pytest.mark.compiler, pytest.mark.root]

Compiled = Callable[..., Path]

ROUNDS = 3
WITH_ITSELF = ["itself_4", "itself_6", "itself_much", "itself_half_closed", "itself_deaf", "itself_ended"]
WITH_OTHERS = ["other_reset", "other_told", "other_ended_unread", "other_ended"]


@pytest.fixture
def peer() -> Iterator[int]:
    """A port at which each caller who says "end" is told "last", and no more."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        kept: list[socket.socket] = []

        def serve() -> None:
            while True:
                try:
                    accepted, _ = listener.accept()
                except OSError:
                    return
                kept.append(accepted)
                threading.Thread(target=_answer, args=(accepted,), daemon=True).start()

        server = threading.Thread(target=serve)
        server.start()
        yield listener.getsockname()[1]
        listener.shutdown(socket.SHUT_RDWR)
        server.join()
        for accepted in kept:
            accepted.close()


def _answer(accepted: socket.socket) -> None:
    try:
        if accepted.recv(4) == b"end\n":
            accepted.sendall(b"last")
            accepted.shutdown(socket.SHUT_WR)
    except OSError:  # closed at the end of the test, or reset
        return


@pytest.mark.parametrize("case", WITH_ITSELF)
def test_a_connection_of_a_program_with_itself_comes_back(case: str, compiled: Compiled, tmp_path: Path) -> None:
    expect_three_lives(start_tracee(compiled("tcp_connections", "-O2"), tmp_path, case), tmp_path)


@pytest.mark.parametrize("case", WITH_OTHERS)
def test_a_connection_with_somebody_else_ends_as_if_he_had_crashed(
    case: str, peer: int, compiled: Compiled, tmp_path: Path
) -> None:
    expect_three_lives(start_tracee(compiled("tcp_connections", "-O2"), tmp_path, case, str(peer)), tmp_path)


def test_a_connection_that_was_asked_for_is_asked_for_anew(compiled: Compiled, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0), backlog=0) as listener:
        port = listener.getsockname()[1]
        with socket.create_connection(("127.0.0.1", port)):  # the queue is full: whoever asks next waits
            tracee = start_tracee(compiled("tcp_connections", "-O2"), tmp_path, "other_asked", str(port))
            with ended(tracee):
                snapshot = captured_and_killed(tracee)
        listener.accept()[0].close()
        with ended(restored(snapshot, tmp_path)) as tracee:
            accepted, _ = listener.accept()
            tracee.tell()
            with accepted:
                _answer(accepted)
                expect_ok(tracee)


@pytest.mark.parametrize(
    ("case", "named"), [("full", "bytes of which have not arrived"), ("encrypted", "which the kernel encrypts")]
)
def test_a_connection_with_itself_that_cannot_be_made_again_is_refused_by_name(
    case: str, named: str, compiled: Compiled, tmp_path: Path
) -> None:
    with ended(start_tracee(compiled("tcp_connections", "-O2"), tmp_path, f"itself_{case}")) as tracee:
        with pytest.raises(UnsupportedError, match=named):
            captured(tracee)
        tracee.tell()
        expect_ok(tracee)


def test_the_report_tells_which_connections_end(peer: int, compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("tcp_connections", "-O2"), tmp_path, "other_reset", str(peer))) as tracee:
        report = ENGINE.probe(tracee.pid)
        assert report.supported
        assert any(f"127.0.0.1 port {peer} is reset" in note for note in report.notes), report.notes


BETWEEN_TWO = """
import os, socket, time
listener = socket.create_server(("127.0.0.1", 0))
child = os.fork()
if not child:
    with socket.create_connection(listener.getsockname()) as asks:
        listener.close()
        while piece := asks.recv(1000):
            asks.sendall(piece.upper())
    os._exit(7)
accepted, _ = listener.accept()
with accepted:
    count = 0
    while not os.path.exists("go"):
        accepted.sendall(b"line %d\\n" % count)
        found = b""
        while not found.endswith(b"\\n"):
            found += accepted.recv(1000)
        print(found.decode().strip(), flush=True)
        count += 1
        time.sleep(0.01)
print("child", os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


def test_a_connection_between_two_processes_of_a_component_comes_back(tmp_path: Path) -> None:
    program = start([sys.executable, "-c", BETWEEN_TWO], tmp_path, isolate=True)
    for round_number in range(ROUNDS):
        with ended(program):
            program.wait_for_output(350 * (round_number + 1))
            report = ENGINE.probe(program.pid)
            assert report.supported and not any("reset" in note for note in report.notes), report
            snapshot = captured_and_killed(program)
        program = restored(snapshot, tmp_path)
    with ended(program):
        program.wait_for_output(350 * (ROUNDS + 1))
        program.tell()
        assert program.finish() == 0, program.complaints
    *lines, last = program.output.splitlines()
    assert (lines, last) == ([f"LINE {count}" for count in range(len(lines))], "child 7")
