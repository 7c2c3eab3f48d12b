"""Shared memory that another process has mapped, too: refused with the cure of its middleware, or detached by rule."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from checkpoint.engine import CaptureOrder, ProtectOrder, Session, Terms
from checkpoint.errors import UnsupportedError
from checkpoint.model import Snapshot
from checkpoint.resources.ipc import middlewares
from tests.checkpoint.round_trip import (
    ENGINE,
    Program,
    as_nobody,
    at_last,
    captured_at_last,
    ended,
    restored,
    start,
    transported,
)

PROGRAM = Path(__file__).with_name("shares_memory.py")
PYTHON = "/usr/bin/python3" if os.path.exists("/usr/bin/python3") else sys.executable
"""One that an ordinary user may run too."""
SIZE = 4 * 4096
PLACE = 8192
"""Where something is said in each piece."""

OTHER = """
import mmap, os, sys, ctypes, time
kept = [mmap.mmap(os.open(path, os.O_RDWR), 0) for path in sys.argv[2:]]
if int(sys.argv[1]) >= 0:
    libc = ctypes.CDLL(None); libc.shmat.restype = ctypes.c_void_p; libc.shmat(int(sys.argv[1]), None, 0)
print("ready", flush=True)
sys.stdin.read()
"""


class Shared:
    """Pieces of shared memory that another process has mapped as long as it lives; the test may write to them."""

    def __init__(self, *names: str, segment: int = -1) -> None:
        self.paths = [f"/dev/shm/{name}" for name in names]
        for path in self.paths:
            with open(path, "wb") as file:
                file.truncate(SIZE)
            os.chmod(path, 0o666)
            self.say(path, "before")
        words = [PYTHON, "-S", "-c", OTHER, str(segment), *self.paths]
        self.other = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert self.other.stdout is not None
        assert self.other.stdout.readline() == b"ready\n"

    def say(self, path: str, what: str) -> None:
        """Write something to a piece."""
        with open(path, "r+b") as file:
            file.seek(PLACE)
            file.write(what.encode().ljust(16, b"\0"))

    def count(self) -> int:
        """How far the program has counted in the first one, as others see it."""
        with open(self.paths[0], "rb") as file:
            return int.from_bytes(file.read(8), "little")

    def close(self) -> None:
        """End the other process, and remove the pieces."""
        self.other.communicate()
        for path in self.paths:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(path)


@contextlib.contextmanager
def shared(*names: str, segment: int = -1) -> Iterator[Shared]:
    """The same for the body."""
    pieces = Shared(*names, segment=segment)
    try:
        yield pieces
    finally:
        pieces.close()


@contextlib.contextmanager
def detaching(program: Program) -> Iterator[Session]:
    """Hold a program under protection by the rule."""
    order = ProtectOrder("/test/shares", terms=Terms(detaches_memory=True))
    session = at_last(lambda: ENGINE.protect(program.pid, order))
    try:
        yield session
    finally:
        session.close()


def started(tmp_path: Path, own: str, read: str = "", segment: int = -1, memory_file: int = -1, *rest: str) -> Program:
    """The program, when it has mapped everything."""
    words = [PYTHON, "-S", "-c", PROGRAM.read_text(), own, read, str(segment), str(memory_file), *rest]
    program = start(words, tmp_path, isolate="child" in rest)  # with its namespace all of them end
    program.wait_for_line("ready")
    return program


def answer(program: Program) -> dict[str, Any]:
    """What the program sees now."""
    told = program.directory / "answer"
    told.unlink(missing_ok=True)
    (program.directory / "ask").touch()
    program.wait_until(told.exists, "its answer")
    found: dict[str, Any] = json.loads(told.read_text())
    return found


def unique(name: str = "failover-test") -> str:
    """A name that no other test has."""
    return f"{name}-{secrets.token_hex(6)}"


# --- Refused, with a cure that can be followed ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "maker", "cure"),
    [
        ("{}.zenoh", "zenoh", "ZENOH_CONFIG_OVERRIDE='transport/shared_memory/enabled=false'"),
        ("fastrtps_{}", "Fast DDS", "FASTDDS_BUILTIN_TRANSPORTS=UDPv4"),
        ("fastdds_port{}", "Fast DDS", "FASTDDS_BUILTIN_TRANSPORTS=UDPv4"),
        ("fast_datasharing_{}", "Fast DDS", "data_sharing to OFF"),
        ("iox2_{}.data", "iceoryx2", "choose another middleware"),
        ("psm_{}", "Python's multiprocessing", "the process that started the others"),
    ],
)
def test_what_a_middleware_shares_is_refused_with_the_switch_that_turns_it_off(
    tmp_path: Path, name: str, maker: str, cure: str
) -> None:
    with shared(name.format(secrets.randbelow(10**9))) as pieces, ended(started(tmp_path, pieces.paths[0])) as program:
        with pytest.raises(UnsupportedError) as refused:
            ENGINE.protect(program.pid, ProtectOrder("/test/shares"))
        said = str(refused.value)
        assert f"the shared memory {pieces.paths[0]} is mapped by pid {pieces.other.pid}" in said
        assert f"{maker} made it" in said
        assert cure in said
        assert "--shared-memory detach" in said


def test_a_middleware_whose_segments_have_any_name_is_known_by_its_library() -> None:
    """RouDi names a segment after a group of users."""
    of_cyclone = middlewares.made_by("/dev/shm/root", ["/usr/lib/x86_64-linux-gnu/libiceoryx_posh.so.2.0.2", "/usr/bin/ddsperf"])
    assert of_cyclone is not None
    assert "<SharedMemory><Enable>false</Enable></SharedMemory>" in of_cyclone.cure
    assert middlewares.made_by("/dev/shm/root", ["/usr/lib/libc.so.6", "/srv/zenoh.txt"]) is None


def test_several_pieces_of_one_middleware_are_told_in_one_sentence(tmp_path: Path) -> None:
    names = [f"{secrets.randbelow(10**9)}.zenoh" for _ in range(2)]
    with shared(*names) as pieces, ended(started(tmp_path, *pieces.paths)) as program:
        with pytest.raises(UnsupportedError) as refused:
            ENGINE.protect(program.pid, ProtectOrder("/test/shares"))
        assert len(refused.value.reasons) == 1
        assert all(path in refused.value.reasons[0] for path in pieces.paths)


# --- Detached by rule ----------------------------------------------------------------------------------------------------


def captured_twice(session: Session, pieces: Shared) -> list[Snapshot]:
    """A base and a delta, between which another process writes to what the program shares."""
    base = transported(captured_at_last(session, CaptureOrder()))
    session.acknowledge(base.position)
    for path in pieces.paths:
        pieces.say(path, "at the capture")
    return [base, transported(captured_at_last(session, CaptureOrder(base=False, sequence=2)))]


def test_detached_memory_comes_back_as_a_copy_of_the_programs_own(tmp_path: Path) -> None:
    with shared(unique(), unique()) as pieces:
        with ended(started(tmp_path, *pieces.paths)) as program, detaching(program) as session:
            chain = captured_twice(session, pieces)
            assert any("resumes with a copy of its own" in note for note in chain[-1].notes)
            program.kill()
        before = pieces.count()
        for path in pieces.paths:
            pieces.say(path, "afterwards")
        with ended(restored(chain, tmp_path)) as program:
            found = answer(program)
            assert (found["own"], found["read"]) == ("at the capture", "at the capture")
            assert found["count"] == found["mine"], "the open file is another one than the mapping"
            later = answer(program)
            assert later["mine"] > found["mine"]
            assert (later["own"], later["read"]) == ("at the capture", "at the capture")
        assert pieces.count() == before, "the restored program wrote to what others have"
        assert pieces.other.poll() is None


def test_processes_of_one_component_still_share_what_is_detached(tmp_path: Path) -> None:
    with shared(unique()) as pieces:
        with ended(started(tmp_path, pieces.paths[0], "", -1, -1, "child")) as program, detaching(program) as session:
            base = transported(captured_at_last(session, CaptureOrder()))
            program.kill()
        seen = pieces.count()
        with ended(restored(base, tmp_path)) as program:
            first = answer(program)["child"]
            program.wait_until(lambda: answer(program)["child"] > first, "its child counting on")
        assert pieces.count() == seen


def test_on_a_machine_without_that_memory_the_program_has_its_copy(tmp_path: Path) -> None:
    with shared(unique(), unique()) as pieces:
        with ended(started(tmp_path, *pieces.paths)) as program, detaching(program) as session:
            chain = captured_twice(session, pieces)
            program.kill()
    with ended(restored(chain, tmp_path)) as program:
        found = answer(program)
        assert (found["own"], found["read"]) == ("at the capture", "at the capture")
        assert not any(os.path.exists(path) for path in pieces.paths), "nobody is to find it by name"
        with detaching(program) as session:  # and it can be captured again, as any program
            again = transported(captured_at_last(session, CaptureOrder()))
            program.kill()
    with ended(restored(again, tmp_path)) as program:
        assert answer(program)["read"] == "at the capture"


@pytest.mark.root
def test_an_ordinary_user_has_his_programs_memory_detached_too() -> None:
    """He may not look into mappings (/proc/PID/map_files): what others wrote to them is carried all the same."""
    text, place = PROGRAM.read_text(), Path(tempfile.mkdtemp(dir="/tmp"))  # not below a folder of root's alone
    place.chmod(0o777)
    with shared(unique(), unique()) as pieces:

        def act() -> str:
            words = [PYTHON, "-S", "-c", text, *pieces.paths, "-1", "-1"]
            with ended(start(words, place)) as program:
                program.wait_for_line("ready")
                with detaching(program) as session:
                    base = transported(captured_at_last(session, CaptureOrder()))
                    program.kill()
            for path in pieces.paths:
                pieces.say(path, "afterwards")
            with ended(restored(base, place, keep_pid=False)) as program:
                found = answer(program)
            return f"{found['own']}, {found['read']}"

        try:
            assert as_nobody_with(pieces, act) == "before, before"
        finally:
            shutil.rmtree(place)


def as_nobody_with(pieces: Shared, act: Callable[[], str]) -> str:
    """Run it as an ordinary user, who sees another process of his that has mapped the pieces."""

    def with_other() -> str:
        with contextlib.ExitStack() as opened:
            for path in pieces.paths:
                opened.enter_context(_mapping(path))
            return act()

    return as_nobody(with_other)


@pytest.mark.root
def test_a_system_v_segment_is_detached_too(tmp_path: Path) -> None:
    libc = ctypes.CDLL(None)
    libc.shmat.restype = ctypes.c_void_p
    segment = libc.shmget(secrets.randbelow(1 << 30) + 1, SIZE, 0o1666)
    assert segment >= 0
    own = libc.shmat(segment, None, 0)
    try:
        ctypes.memmove(own + PLACE, b"at the capture\0", 15)
        with shared(unique(), segment=segment) as pieces:
            with ended(started(tmp_path, pieces.paths[0], "", segment)) as program:
                with pytest.raises(UnsupportedError, match="--shared-memory detach"):
                    ENGINE.protect(program.pid, ProtectOrder("/test/shares"))
                with detaching(program) as session:
                    base = transported(captured_at_last(session, CaptureOrder()))
                    program.kill()
            ctypes.memmove(own + PLACE, b"afterwards\0\0\0\0\0", 15)
            with ended(restored(base, tmp_path)) as program:
                assert answer(program)["segment"] == "at the capture"
    finally:
        libc.shmdt(ctypes.c_void_p(own))
        libc.shmctl(segment, 0, None)


def test_a_memory_file_is_detached_too(tmp_path: Path) -> None:
    made = os.memfd_create("failover-test", 0)
    os.truncate(made, SIZE)
    os.set_inheritable(made, True)
    os.pwrite(made, b"at the capture", PLACE)
    kept = f"/proc/{os.getpid()}/fd/{made}"
    with shared(unique()) as pieces, _mapping(kept), ended(_with_memory_file(tmp_path, pieces.paths[0], made)) as program:
        with detaching(program) as session:
            base = transported(captured_at_last(session, CaptureOrder()))
            program.kill()
        os.pwrite(made, b"afterwards\0\0\0\0", PLACE)
        with ended(restored(base, tmp_path)) as again:
            assert answer(again)["memory_file"] == "at the capture"
    os.close(made)


@contextlib.contextmanager
def _mapping(path: str) -> Iterator[None]:
    """Another process that has mapped a file, for the body."""
    words = [PYTHON, "-S", "-c", OTHER, "-1", path]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"ready\n"
        yield
        other.communicate()


def _with_memory_file(tmp_path: Path, own: str, made: int) -> Program:
    """The program, which opens the memory file by the descriptor of ours; vessels inherit none."""
    script = tmp_path / "opens.py"
    script.write_text(
        f"import os, sys\nfile = os.open('/proc/{os.getpid()}/fd/{made}', os.O_RDWR)\n"
        f"sys.argv = ['', {own!r}, '', '-1', str(file)]\nexec(open({str(PROGRAM)!r}).read())\n"
    )
    program = start([sys.executable, script], tmp_path)
    program.wait_for_line("ready")
    return program


def test_what_is_open_but_mapped_in_part_is_refused_by_the_rule_too(tmp_path: Path) -> None:
    with shared(unique()) as pieces:
        script = tmp_path / "part.py"
        script.write_text(
            f"import mmap, os, time\nfile = os.open({pieces.paths[0]!r}, os.O_RDWR)\nkept = mmap.mmap(file, 4096)\n"
            "print('ready', flush=True)\nwhile True: time.sleep(0.01)\n"
        )
        program = start([sys.executable, script], tmp_path)
        with ended(program):
            program.wait_for_line("ready")
            order = ProtectOrder("/test/shares", terms=Terms(detaches_memory=True))
            with pytest.raises(UnsupportedError, match="only what is mapped can be detached"):
                ENGINE.protect(program.pid, order)
