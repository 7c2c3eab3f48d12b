"""What a restore took from a program is told with every snapshot, until the program has it again: for `failover status`."""

from __future__ import annotations

import contextlib
import os
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from checkpoint.engine import CaptureOrder
from checkpoint.keeper.messages import Capture, Captured, Restore, Restored, Resume, Resumed, close_all
from checkpoint.linux.spawn.vessel import Birth, Born, discard, elapsed_since, spawn_vessel
from checkpoint.model import Snapshot
from checkpoint.snapshot import format
from failover.cli.keeper_client import Keeper
from tests.checkpoint.round_trip import Program, at_last, captured_at_last, ended, protected, start

pytestmark = pytest.mark.root

TALKER = """
import os, socket, sys, time
listener = socket.create_server(("127.0.0.1", 0))
print("port", listener.getsockname()[1], flush=True)
kept = [socket.create_connection(("127.0.0.1", int(port))) for port in sys.argv[1].split(",")]
accepted, _ = listener.accept()
print("ready", flush=True)
while not os.path.exists("go"):
    time.sleep(0.005)
for one in (*kept, accepted):
    one.close()
kept = [socket.create_connection(("127.0.0.1", int(port))) for port in sys.argv[1].split(",")]
accepted, _ = listener.accept()
print("anew", flush=True)
while True:
    time.sleep(1)
"""


@contextlib.contextmanager
def peers(count: int) -> Iterator[list[socket.socket]]:
    """Listeners that accept whoever comes: the kernel does, nobody asks them."""
    with contextlib.ExitStack() as opened:
        yield [opened.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)]


@contextlib.contextmanager
def in_keeper(snapshot: Snapshot, directory: Path) -> Iterator[tuple[Keeper, tuple[str, ...], Program]]:
    """The program of a snapshot, restored and followed by a keeper; and what the restore has to say."""
    out = os.open(directory / "out", os.O_WRONLY | os.O_APPEND)
    file = os.memfd_create("snapshot")
    os.write(file, format.encode_bytes(snapshot))
    born: Born | None = None
    with Keeper.spawn() as keeper:
        try:
            born = spawn_vessel(Birth(inner_pid=snapshot.process.pid, stdio=(out, out, out)))
            order = Restore(born.pid, snapshot.component, elapsed_since(snapshot.clocks), follow=True)
            restored, _ = keeper.ask(order, Restored, (file,))
            keeper.ask(Resume(), Resumed)
            yield keeper, restored.notes, Program(born, directory)
        finally:
            close_all((out, file))
            if born is not None:
                discard(born)


def notes_now(keeper: Keeper, sequence: int) -> list[str]:
    """Those of the next snapshot that are of connections or memory."""
    captured, files = at_last(lambda: keeper.ask(Capture(base=True, generation=2, sequence=sequence), Captured))
    close_all(files)
    return [note for note in captured.notes if note.startswith(("its connections", "its shared memory"))]


def test_that_connections_were_reset_is_told_until_they_are_open_again(tmp_path: Path) -> None:
    with peers(2) as listeners:
        ports = [listener.getsockname()[1] for listener in listeners]
        program = start([sys.executable, "-c", TALKER, ",".join(map(str, ports))], tmp_path)
        with ended(program), contextlib.ExitStack() as ours:
            program.wait_until(lambda: "port" in program.output, "its port")
            own = int(program.output.split()[1])
            ours.enter_context(socket.create_connection(("127.0.0.1", own)))
            program.wait_for_line("ready")
            with protected(program, "/test/talker") as session:
                snapshot = captured_at_last(session, CaptureOrder())
                program.kill()
        with in_keeper(snapshot, tmp_path) as (keeper, notes, again), contextlib.ExitStack() as ours:
            (told,) = [note for note in notes if note.startswith("its connections were reset")]
            assert f"3 TCP connections with 127.0.0.1 port {ports[0]}" in told
            assert f"others had opened 1 of them, to its port {own}" in told
            assert "after_resume" in told
            assert notes_now(keeper, 1) == [told]
            assert notes_now(keeper, 2) == [told], "it is said as long as it holds"
            again.tell()
            ours.enter_context(socket.create_connection(("127.0.0.1", own)))
            again.wait_for_line("anew")
            assert notes_now(keeper, 3) == []
