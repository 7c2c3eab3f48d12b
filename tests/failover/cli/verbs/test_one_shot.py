"""capture, restore, inspect and check as a person types them, on real programs: the output is that of an undisturbed run."""

from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from checkpoint.engines import capability_table
from checkpoint.errors import CaptureError, CheckpointError, ProcessGoneError, UnsupportedError
from checkpoint.keeper.messages import Capture, Captured, Restore, Restored, Resume, Resumed, close_all
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.tasks import thread_ids
from checkpoint.linux.spawn.vessel import Birth, discard, spawn_vessel
from failover.cli.keeper_client import Keeper
from failover.cli.verbs import one_shot
from tests.checkpoint.round_trip import everybody_below
from tests.failover.cli.test_verbs import failover

PYTHON = getattr(sys, "_base_executable", sys.executable)
BOUND_S = 60.0

LINES = 800

COUNT = f"""\
import hashlib, os, sys, time
digest = hashlib.sha256()
for number in range(1, {LINES} + 1):
    digest.update(str(number).encode())
    print(number, digest.hexdigest(), flush=True)
    if not os.path.exists("hurry"):
        time.sleep(0.05)
    while number == {LINES // 2} and not os.path.exists("hurry"):
        time.sleep(0.05)
sys.exit(7)
"""
"""Takes its time, and waits half way, however long a busy machine takes, until the test has done with it what it wants to do."""

CHAOS = f"""\
$| = 1;
my $x = 0.4;
for my $number (1 .. {LINES}) {{
    $x = 3.99 * $x * (1 - $x) for 1 .. 1000;
    print "$number $x\\n";
    until (-e "hurry") {{
        my $aside = $x;
        $aside = 3.99 * $aside * (1 - $aside) for 1 .. 100_000;
        last if $number != {LINES // 2};
    }}
}}
"""
"""The same in a language whose interpreter is not ours. It never sleeps: captures find it in the midst of floating numbers."""


def wait_for(what: str, condition: Callable[[], bool], bound_s: float = BOUND_S) -> None:
    """Poll until a condition holds."""
    deadline = time.monotonic() + bound_s
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        time.sleep(0.002)


def lines(path: Path) -> int:
    """How many lines a program has written so far."""
    return path.read_bytes().count(b"\n")


class Script:
    """A program whose standard streams are files in a directory of its own."""

    def __init__(self, directory: Path, argv: list[str], text: str) -> None:
        self.directory = directory
        self.argv = argv
        (directory / "program").write_text(text)

    def hurry(self) -> None:
        """Have it come to its end; what it writes does not depend on its pauses."""
        (self.directory / "hurry").touch()

    def expected(self) -> bytes:
        """What it writes when nobody disturbs it."""
        self.hurry()
        self.run(self.directory / "expected").wait()
        (self.directory / "hurry").unlink()
        return (self.directory / "expected").read_bytes()

    def run(self, output: Path) -> subprocess.Popen[bytes]:
        """Start it."""
        with output.open("ab") as file:
            return subprocess.Popen(
                self.argv,
                cwd=self.directory,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                start_new_session=True,
                env={"PATH": os.environ["PATH"], "LANG": "C.UTF-8"},
            )


@pytest.fixture(params=["python", pytest.param("perl", marks=pytest.mark.command("perl"))])
def script(request: pytest.FixtureRequest, tmp_path: Path) -> Script:
    """A program that nobody prepared."""
    if request.param == "python":
        return Script(tmp_path, [PYTHON, "program"], COUNT)
    return Script(tmp_path, [shutil.which("perl") or "perl", "program"], CHAOS)


def has_ended(pid: int) -> bool:
    """Whether a process is gone, or a zombie that was our grandchild (and is reaped here)."""
    with contextlib.suppress(ChildProcessError):
        os.waitpid(pid, os.WNOHANG)
    return not Path(f"/proc/{pid}").exists()


@pytest.mark.timeout(5 * BOUND_S)
def test_a_program_captured_and_restored_three_times_in_a_row_writes_what_an_undisturbed_one_writes(script: Script) -> None:
    expected, output = script.expected(), script.directory / "output"
    process = script.run(output)
    pid = process.pid
    for turn in range(1, 4):
        wait_for("some output", lambda turn=turn: lines(output) >= turn * 10)  # type: ignore[misc]
        file = script.directory / f"snapshot{turn}"
        captured = failover("capture", str(pid), "-o", str(file))
        assert captured.returncode == 0, captured.stderr
        wait_for("the captured program to end", lambda pid=pid: process.poll() is not None and has_ended(pid))  # type: ignore[misc]
        assert file.stat().st_mode & 0o777 == 0o600
        restored = failover("restore", str(file))
        assert restored.returncode == 0, restored.stderr
        assert re.fullmatch(r"\d+\n", restored.stdout)
        pid = int(restored.stdout)
    script.hurry()
    wait_for("the end", lambda: has_ended(pid))
    assert output.read_bytes() == expected


def test_waiting_passes_on_the_exit_status_of_the_restored_program(tmp_path: Path) -> None:
    script = Script(tmp_path, [PYTHON, "program"], COUNT)
    process = script.run(tmp_path / "output")
    wait_for("some output", lambda: lines(tmp_path / "output") >= 10)
    assert failover("capture", str(process.pid), "-o", str(tmp_path / "snapshot")).returncode == 0
    process.wait()
    script.hurry()
    ran = failover("restore", "--wait", str(tmp_path / "snapshot"))
    assert ran.returncode == 7, ran.stderr
    assert lines(tmp_path / "output") == LINES


BY_ITS_PID = {
    "a program of two processes": "import subprocess; subprocess.run(['sleep', '600'])",
    "a program of two threads": "import threading, time; threading.Thread(target=time.sleep, args=[600]).start()",
}


@pytest.fixture(params=BY_ITS_PID.values(), ids=list(BY_ITS_PID))
def taken(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[int, Path]]:
    """A program that knows itself by several PIDs and runs on: its PID, and its snapshot."""
    with subprocess.Popen([PYTHON, "-c", request.param], stdout=subprocess.DEVNULL, start_new_session=True) as process:
        try:
            wait_for("its other half", lambda: len(everybody_below(process.pid)) + len(thread_ids(process.pid)) == 2)
            captured = failover("capture", "--leave-running", str(process.pid), "-o", str(tmp_path / "snapshot"))
            assert captured.returncode == 0, captured.stderr
            yield process.pid, tmp_path / "snapshot"
        finally:
            os.killpg(process.pid, signal.SIGKILL)


def test_a_restore_that_comes_to_nothing_in_the_middle_leaves_a_vessel_that_can_be_ended(taken: tuple[int, Path]) -> None:
    pid, snapshot = taken
    file = os.open(snapshot, os.O_RDONLY | os.O_CLOEXEC)
    born = spawn_vessel(Birth())
    with Keeper.spawn() as keeper:
        with pytest.raises(CheckpointError, match=f"pid {pid}, by which they know it, is not available"):
            keeper.ask(Restore(born.pid, "/test/taken", 0), Restored, (file,))
        with contextlib.suppress(ProcessLookupError):
            os.kill(born.pid, signal.SIGKILL)
        wait_for("the end of the vessel, while its tracer lives", lambda: os.waitpid(born.pid, os.WNOHANG)[0] == born.pid)
    os.close(file)


@pytest.mark.root
def test_a_program_whose_pids_are_taken_goes_on_in_pids_of_its_own(taken: tuple[int, Path]) -> None:
    pid, snapshot = taken
    restored = failover("restore", str(snapshot))
    assert restored.returncode == 0, restored.stderr
    back = int(restored.stdout)
    try:
        assert back != pid
        assert "it runs in a PID namespace of its own" in restored.stderr
        assert procfs.status(back).pids[-1] == pid
    finally:
        os.kill(back, signal.SIGKILL)
        wait_for("its end", lambda: has_ended(back))


@pytest.mark.parametrize(
    ("error", "tries"),
    [(CaptureError("no processor"), one_shot.CAPTURE_TRIES), (UnsupportedError("a vfork"), one_shot.REFUSED_TRIES)],
    ids=["a bad moment", "a refusal"],
)
def test_what_fails_is_asked_again_a_few_times(error: CheckpointError, tries: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(one_shot, "CAPTURE_PAUSE_S", 0.0)
    asked = []

    def ask(helps: int) -> str:
        asked.append(helps)
        if len(asked) < helps:
            raise error
        return "captured"

    assert one_shot._at_last(4711, lambda: ask(tries)) == "captured"
    asked.clear()
    with pytest.raises(type(error)):
        one_shot._at_last(4711, lambda: ask(tries + 1))
    assert len(asked) == tries


def test_a_refusal_is_believed_when_it_comes_again_in_the_same_words(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a program that forks constantly each refusal is of another child."""
    monkeypatch.setattr(one_shot, "CAPTURE_PAUSE_S", 0.0)
    asked = []

    def ask() -> str:
        asked.append(1)
        if len(asked) < one_shot.CAPTURE_TRIES:
            raise UnsupportedError("cannot capture", (f"its process {len(asked)} shares its memory",))
        return "captured"

    assert one_shot._at_last(4711, ask) == "captured"


def test_a_capture_that_never_works_says_what_was_tried_and_what_helps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(one_shot, "CAPTURE_PAUSE_S", 0.0)

    def ask() -> None:
        raise CaptureError("process 12 takes long to end; capture it again")

    with pytest.raises(CaptureError) as told:
        one_shot._at_last(4711, ask)
    said = str(told.value)
    assert said.startswith("cannot capture pid 4711, which runs on: process 12 takes long to end. failover tried 12 times in ")
    assert "capture it again" not in said
    assert "kill -STOP 4711" in said


def test_a_program_that_has_gone_is_not_asked_for_again() -> None:
    asked = []

    def ask() -> None:
        asked.append(1)
        raise ProcessGoneError("it ended")

    with pytest.raises(ProcessGoneError):
        one_shot._at_last(4711, ask)
    assert len(asked) == 1


IMPATIENT = """
import sys
from checkpoint.engines.ptrace.capture import session
session.MOVED_S = -1.0
from failover.__main__ import main
sys.exit(main())
"""
"""The command, whose keeper makes a freeze again only once, as where those after the first fail for two seconds."""
FORKS = {
    "a shell": ["sh", "-c", "n=0; while :; do n=$((n + 1)); /bin/true; echo $n; done"],
    "forks": [
        PYTHON,
        "-c",
        "import os\nn = 0\nwhile True:\n    if not os.fork(): os._exit(0)\n    os.wait(); n += 1; print(n, flush=True)",
    ],
    "starts programs": [
        PYTHON,
        "-c",
        "import subprocess\nn = 0\nwhile True:\n    subprocess.run(['sleep', '0.02']); n += 1; print(n, flush=True)",
    ],
}


@pytest.mark.parametrize("argv", FORKS.values(), ids=FORKS)
def test_a_program_that_forks_all_the_time_is_captured_by_one_command(argv: list[str], tmp_path: Path) -> None:
    output = tmp_path / "output"
    with output.open("ab") as file:
        process = subprocess.Popen(argv, stdin=subprocess.DEVNULL, stdout=file, stderr=file, start_new_session=True)
    pid = process.pid
    try:
        for _ in range(2):
            seen = lines(output)
            wait_for("it to count", lambda seen=seen: lines(output) > seen + 3)  # type: ignore[misc]
            command = [sys.executable, "-c", IMPATIENT, "capture", str(pid), "-o", str(tmp_path / "snapshot"), "--force"]
            captured = subprocess.run(command, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
            assert captured.returncode == 0, captured.stderr
            process.wait()
            wait_for("it to be gone", lambda pid=pid: has_ended(pid))  # type: ignore[misc]
            restored = failover("restore", str(tmp_path / "snapshot"))
            assert restored.returncode == 0, restored.stderr
            pid = int(restored.stdout)
        seen = lines(output)
        wait_for("it to count on", lambda: lines(output) > seen + 3)
    finally:
        for one in (*everybody_below(pid), pid):
            with contextlib.suppress(ProcessLookupError):
                os.kill(one, signal.SIGKILL)
        process.wait()
    counted = [int(line) for line in output.read_text().split()]
    assert counted == list(range(1, len(counted) + 1))


def test_who_was_captured_is_dead_when_the_command_returns(tmp_path: Path) -> None:
    argv = [PYTHON, "-c", "import os, time; x = os.urandom(64 << 20); print('ready', flush=True); time.sleep(600)"]
    with subprocess.Popen(argv, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        captured = failover("capture", str(process.pid), "-o", str(tmp_path / "snapshot"))
        assert captured.returncode == 0, captured.stderr
        assert os.waitpid(process.pid, os.WNOHANG) == (process.pid, signal.SIGKILL)
        process.returncode = -signal.SIGKILL


TRACER = """
import sys
from checkpoint.linux.trace.tracee import Tracee
tracee = Tracee(int(sys.argv[1]))
tracee.seize()
tracee.freeze()
print("ready", flush=True)
sys.stdin.read()
"""
"""Takes no note of its tracee's end, and goes when its standard input does."""


def test_an_end_of_which_the_tracer_has_taken_no_note_yet_is_waited_for() -> None:
    """Its parent is told when the tracer has, or has gone."""
    with subprocess.Popen([PYTHON, "-c", "import time; time.sleep(600)"]) as process:
        argv = [sys.executable, "-c", TRACER, str(process.pid)]
        with subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as tracer:
            assert tracer.stdin is not None
            assert tracer.stdout is not None
            assert tracer.stdout.readline() == b"ready\n"
            goes = threading.Timer(0.3, tracer.stdin.close)
            with one_shot._ended(process.pid):
                goes.start()
            assert os.waitpid(process.pid, os.WNOHANG) == (process.pid, signal.SIGKILL)
            process.returncode = -signal.SIGKILL
            goes.join()


def test_a_program_left_running_writes_what_an_undisturbed_one_writes(tmp_path: Path) -> None:
    script = Script(tmp_path, [PYTHON, "program"], COUNT)
    expected, process = script.expected(), script.run(tmp_path / "output")
    for turn in range(3):
        wait_for("some output", lambda turn=turn: lines(tmp_path / "output") >= 10 * (turn + 1))  # type: ignore[misc]
        ran = failover("capture", str(process.pid), "--leave-running", "--json", "--force", "-o", str(tmp_path / "snapshot"))
        assert ran.returncode == 0, ran.stderr
        assert json.loads(ran.stdout)["running"] is True
    script.hurry()
    assert process.wait() == 7
    assert (tmp_path / "output").read_bytes() == expected


@pytest.fixture(scope="module")
def snapshot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A snapshot's file of a Python program."""
    directory = tmp_path_factory.mktemp("snapshot")
    script = Script(directory, [PYTHON, "program"], COUNT)
    process = script.run(directory / "output")
    wait_for("some output", lambda: lines(directory / "output") >= 5)
    ran = failover("capture", str(process.pid), "-o", str(directory / "snapshot"))
    process.kill()
    process.wait()
    assert ran.returncode == 0, ran.stderr
    return directory / "snapshot"


@pytest.mark.parametrize("follow", [True, False])
def test_a_restored_program_is_protected_again_only_where_that_is_wanted(snapshot: Path, follow: bool) -> None:
    file = os.open(snapshot, os.O_RDONLY | os.O_CLOEXEC)
    born = spawn_vessel(Birth())
    try:
        with Keeper.spawn() as keeper:
            keeper.ask(Restore(born.pid, "/test/followed", follow=follow), Restored, (file,))
            keeper.ask(Resume(), Resumed)
            allowed = contextlib.nullcontext() if follow else pytest.raises(CaptureError, match="follows no process")
            with allowed:
                _, found = keeper.ask(Capture(base=True, generation=1, sequence=1), Captured)
                close_all(found)
    finally:
        os.close(file)
        discard(born)


def test_inspect_shows_what_a_snapshot_holds(snapshot: Path) -> None:
    ran = failover("inspect", "--vmas", str(snapshot))
    assert ran.returncode == 0, ran.stderr
    for wanted in (f"{PYTHON} program", "base (whole)", "[stack]", "output", "heap"):
        assert wanted in ran.stdout
    as_json = json.loads(failover("inspect", "--json", str(snapshot)).stdout)
    assert as_json["process"]["arguments"][1:] == ["program"]
    assert as_json["file_size"] == snapshot.stat().st_size
    assert as_json["contents_size"] > 0


def test_a_snapshot_with_one_flipped_bit_is_refused_by_every_verb_that_reads_it(snapshot: Path, tmp_path: Path) -> None:
    content = bytearray(snapshot.read_bytes())
    content[len(content) // 2] ^= 1
    altered = tmp_path / "altered"
    altered.write_bytes(content)
    for words in (["inspect"], ["restore"]):
        ran = failover(*words, str(altered))
        assert ran.returncode == 1
        assert ran.stderr.startswith("failover: ")


@pytest.mark.parametrize("size", [0, 7, 4096, -1])
def test_a_truncated_snapshot_is_refused(snapshot: Path, tmp_path: Path, size: int) -> None:
    short = tmp_path / "short"
    short.write_bytes(snapshot.read_bytes()[:size])
    for verb in ("inspect", "restore"):
        assert failover(verb, str(short)).returncode == 1


def test_a_file_that_is_missing_is_said_to_be(tmp_path: Path) -> None:
    for verb in ("inspect", "restore"):
        ran = failover(verb, str(tmp_path / "nothing"))
        assert ran.returncode == 1
        assert "nothing" in ran.stderr


def test_a_file_that_takes_no_more_is_said_so_and_the_program_runs_on(tmp_path: Path) -> None:
    argv = [PYTHON, "-c", "import os, time; x = os.urandom(16 << 20); print('ready', flush=True); time.sleep(600)"]
    with subprocess.Popen(argv, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        try:
            process.stdout.readline()
            words = [sys.executable, "-m", "failover", "capture", str(process.pid), "-o", str(tmp_path / "snapshot")]
            bound = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (4 << 20, 4 << 20))  # noqa: E731
            ran = subprocess.run(words, capture_output=True, text=True, check=False, preexec_fn=bound, timeout=BOUND_S)
            assert ran.returncode == 1
            assert "File too large; the program was not ended" in ran.stderr
            assert process.poll() is None
            wait_for("the program to go on", lambda: procfs.status(process.pid).state == "S")
            assert procfs.status(process.pid).tracer == 0
        finally:
            process.kill()
    assert list(tmp_path.iterdir()) == []


def test_a_process_that_does_not_exist_cannot_be_captured(tmp_path: Path) -> None:
    gone = subprocess.Popen(["true"])
    gone.wait()
    for words in (["capture", "-o", str(tmp_path / "x")], ["check"]):
        ran = failover(*words, str(gone.pid))
        assert ran.returncode == 1
        assert str(gone.pid) in ran.stderr
    assert list(tmp_path.iterdir()) == []


def test_an_existing_file_is_not_overwritten_unless_asked(tmp_path: Path) -> None:
    target = tmp_path / "precious"
    target.write_text("precious")
    ran = failover("capture", str(os.getpid()), "-o", str(target))
    assert ran.returncode == 1
    assert "--force" in ran.stderr
    assert target.read_text() == "precious"


def test_check_names_what_stands_against_a_capture_and_touches_nothing(tmp_path: Path) -> None:
    with subprocess.Popen(
        [
            PYTHON,
            "-c",
            "import os, sys; a = os.pidfd_open(os.getppid()); print(flush=True); sys.stdin.read()",
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        ran = failover("check", str(process.pid))
        assert ran.returncode == 1, ran.stderr
        assert "pidfd" in ran.stdout
        refused = failover("capture", str(process.pid), "-o", str(tmp_path / "x"))
        assert refused.returncode == 1
        assert "pidfd" in refused.stderr
        assert process.poll() is None
        process.communicate()
    assert process.returncode == 0


@pytest.mark.parametrize("kind", ["refused", "a thread", "ended"])
def test_each_verb_refuses_a_process_in_its_own_name(kind: str, tmp_path: Path) -> None:
    holder = "import os, sys, threading\nos.pidfd_open(os.getppid())\nthreading.Thread(target=sys.stdin.read).start()\n"
    with subprocess.Popen([PYTHON, "-c", holder], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as process:
        assert process.stdin is not None
        wait_for("its thread", lambda: len(thread_ids(process.pid)) == 2)
        pid = process.pid
        if kind == "a thread":
            (pid,) = set(thread_ids(process.pid)) - {process.pid}
        elif kind == "ended":
            process.stdin.close()
            wait_for("its end", lambda: procfs.status(process.pid).has_ended)
        for words in (["check", str(pid)], ["capture", str(pid), "-o", str(tmp_path / "x")]):
            ran = failover(*words)
            assert ran.returncode == 1 and "protect" not in ran.stderr, ran.stderr
            if not (kind == "refused" and words[0] == "check"):  # which shows a table
                assert f"cannot {words[0]} " in ran.stderr and str(pid) in ran.stderr
        process.stdin.close()


def test_check_without_a_pid_says_what_this_machine_offers() -> None:
    ran = failover("check", "--json")
    offers = json.loads(ran.stdout)["offers"]
    assert {offer["what"] for offer in offers} >= {"processor", "looking into programs", "written pages"}
    assert ran.returncode == 0


def test_check_shows_the_table_of_what_comes_back_as_the_code_has_it() -> None:
    ran = failover("check", "--table", "--json")
    rows = [(row["area"], row["kind"], row["verdict"], row["sentence"]) for row in json.loads(ran.stdout)]
    assert rows == [(row.area, row.kind, row.verdict, row.sentence) for row in capability_table.rows()]
    told = failover("check", "--table").stdout
    assert [row.kind for row in capability_table.rows() if row.kind not in told] == []


FILTERED = """
import ctypes, os, struct, sys
allow = ctypes.create_string_buffer(struct.pack("HBBI", 0x06, 0, 0, 0x7FFF0000))  # BPF_RET, SECCOMP_RET_ALLOW
program = struct.pack("HxxxxxxP", 1, ctypes.addressof(allow))
libc = ctypes.CDLL(None)
assert libc.prctl(38, 1, 0, 0, 0) == 0  # PR_SET_NO_NEW_PRIVS
assert libc.prctl(22, 2, program) == 0  # PR_SET_SECCOMP, SECCOMP_MODE_FILTER
os.execv(sys.executable, [sys.executable, "-m", "failover.cli.main", *sys.argv[1:]])
"""
"""Runs our command as a container does: under a seccomp filter, which every program started there inherits."""


def test_check_without_a_pid_tries_a_capture_and_says_what_forbids_it() -> None:
    ran = subprocess.run([sys.executable, "-c", FILTERED, "check", "--json"], capture_output=True, text=True, check=False)
    assert ran.returncode == 1, ran.stderr
    missing = [offer for offer in json.loads(ran.stdout)["offers"] if offer["verdict"] == "missing"]
    assert ["seccomp filter" in offer["text"] for offer in missing] == [True]


def test_a_signal_that_ends_a_restored_program_is_passed_on_as_shells_do(snapshot: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-m", "failover.cli.main", "restore", "--wait", str(snapshot)], stdout=subprocess.PIPE
    ) as ran:
        assert ran.stdout is not None
        os.kill(int(ran.stdout.readline()), signal.SIGKILL)
        assert ran.wait() == 137


def test_a_program_with_a_line_is_captured_and_restored_by_the_rule_that_is_given(tmp_path: Path) -> None:
    ours, theirs = os.openpty()
    path = os.ttyname(theirs)
    hold = f"import os; line = os.open({path!r}, os.O_RDWR | os.O_NOCTTY); print(flush=True)"
    hold += "; os.read(line, 9); os.write(line, b'here')"
    try:
        with subprocess.Popen([PYTHON, "-c", hold], stdout=subprocess.PIPE, stdin=subprocess.DEVNULL) as process:
            assert process.stdout is not None
            process.stdout.readline()
            file = str(tmp_path / "x")
            assert failover("capture", str(process.pid), "-o", file).returncode == 1
            wrong = failover("capture", str(process.pid), "-o", file, "--device", f"{path}=close")
            assert wrong.returncode == 2, wrong
            assert "say reopen, hook, optional, or the path" in wrong.stderr
            assert failover("capture", str(process.pid), "-o", file, "--device", f"{path}=reopen").returncode == 0
        with subprocess.Popen(
            [sys.executable, "-m", "failover.cli.main", "restore", file, "--wait"], stdout=subprocess.DEVNULL
        ) as restoring:
            os.write(ours, b"say\n")
            heard = b""
            while b"here" not in heard:  # the line echoes what we say
                heard += os.read(ours, 100)
            assert restoring.wait(BOUND_S) == 0
    finally:
        os.close(theirs)
        os.close(ours)
