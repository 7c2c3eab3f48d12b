"""A snapshot's file is its owner's word: root's restore gives it its owner's rights at most, whichever it asks for, and says so.

Each field of a snapshot that carries authority is changed by the project's own encoder; the restored rights are read from /proc.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import pty
import random
import resource
import shutil
import signal
import stat
import subprocess
import sys
import termios
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec.structs import replace

from agent.worker.components.restore_limits import check_rights
from checkpoint.errors import AuthorError, CheckpointError
from checkpoint.keeper.messages import Restore, Restored, Resume, Resumed
from checkpoint.linux import file_author
from checkpoint.linux.procfs import descendants, procfs
from checkpoint.linux.spawn.inherited_limits import Inheritance
from checkpoint.linux.spawn.vessel import Birth, discard, spawn_vessel
from checkpoint.model import Credentials, Fact, Member, Resource, Snapshot
from checkpoint.snapshot import credentials, format
from checkpoint.snapshot.canonical_state import decode_state, encode_state
from checkpoint.snapshot.carried_files import Entry, Tree
from checkpoint.snapshot.credentials import Owner
from checkpoint.store.chain import position_of
from failover.cli.keeper_client import Keeper
from tests.failover.cli.test_verbs import failover
from tests.failover.cli.verbs.test_one_shot import has_ended, wait_for

pytestmark = [pytest.mark.root, pytest.mark.command("sleep"), pytest.mark.command("setpriv")]

OWNER = 41234
"""A user without an account, and so without a group."""
OTHER = 41235
NO_GROUP = int(Path("/proc/sys/kernel/overflowgid").read_text())
ALL_OF_THEM = int(procfs.parse_fields(Path("/proc/self/status").read_text())["CapEff"], 16)
SYS_ADMIN = 1 << 21
SEEDS = 4 + int(os.environ.get("FAILOVER_TEST_SEEDS", "0"))
CRAFTED_A_SEED = 6


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Snapshot:
    """A program of root's that anybody may start."""
    return taken([shutil.which("sleep") or "sleep", "1000"], tmp_path_factory.mktemp("honest") / "file")


def taken(words: list[str], file: Path) -> Snapshot:
    """A snapshot of a program that holds nothing but /dev/null."""
    nothing = subprocess.DEVNULL
    with subprocess.Popen(words, cwd="/", stdin=nothing, stdout=nothing, stderr=nothing, start_new_session=True) as program:
        wait_for("the program", lambda: procfs.status(program.pid).state == "S")
        ran = failover("capture", str(program.pid), "-o", str(file))
        program.kill()
    assert ran.returncode == 0, ran.stderr
    return format.decode(file)


@pytest.fixture
def place() -> Iterator[Path]:
    """A directory of root's that every user may enter."""
    found = Path("/tmp") / f"rights-{os.getpid()}"
    found.mkdir(0o755)
    yield found
    shutil.rmtree(found)


def written(crafted: Snapshot, file: Path, owner: int = OWNER, mode: int = 0o600) -> Path:
    """The snapshot as a file of somebody's, who knows how to name it."""
    file.write_bytes(format.encode_bytes(replace(crafted, position=position_of(crafted, 1, 1))))
    os.chown(file, owner, owner)
    file.chmod(mode)
    return file


class Back:
    """A program that was restored, if it was."""

    def __init__(self, ran: subprocess.CompletedProcess[str]) -> None:
        self.ran = ran
        told = json.loads(ran.stdout)
        self.pid = int(told.get("pid", 0))
        self.notes = "\n".join(told.get("notes", ()))
        self.error = str(told.get("message", ""))

    @property
    def pids(self) -> tuple[int, ...]:
        return (self.pid, *descendants.component(self.pid)) if self.pid else ()

    def end(self) -> None:
        for pid in reversed(self.pids):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        if self.pid:
            wait_for("its end", lambda: has_ended(self.pid))


@contextlib.contextmanager
def restored(file: Path, *words: str, uid: int = 0) -> Iterator[Back]:
    """What comes of a restore; it is ended."""
    if not uid:
        back = Back(failover("restore", "--json", *words, str(file)))
    else:
        become = ["setpriv", f"--reuid={uid}", f"--regid={uid}", "--clear-groups"]
        command = [*become, sys.executable, "-m", "failover", "restore", "--json", *words, str(file)]
        ran = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
        assert "Traceback" not in ran.stderr + ran.stdout, ran.stderr
        back = Back(ran)
    try:
        yield back
    finally:
        back.end()


def more_than(uid: int, pid: int) -> Iterator[str]:
    """What a process, in any of its threads, has that an ordinary user would not have got by himself."""
    ceilings = hard_limits(os.getpid())
    for task in map(int, os.listdir(f"/proc/{pid}/task")):
        fields = procfs.parse_fields(Path(f"/proc/{pid}/task/{task}/status").read_text())
        yield from (f"{name} {fields[name]}" for name in ("Uid",) if set(fields[name].split()) != {str(uid)})
        groups = set(fields["Gid"].split()) | set(fields.get("Groups", "").split())
        yield from (f"group {gid}" for gid in groups - {str(NO_GROUP), str(uid)})
        if os.readlink(f"/proc/{pid}/ns/user") == os.readlink("/proc/self/ns/user"):  # in one of his own he may be what he likes
            yield from (f"{name} {fields[name]}" for name in ("CapInh", "CapPrm", "CapEff", "CapAmb") if int(fields[name], 16))
        if os.sched_getscheduler(task) not in (os.SCHED_OTHER, os.SCHED_BATCH, os.SCHED_IDLE):
            yield f"policy {os.sched_getscheduler(task)}"
        if os.getpriority(os.PRIO_PROCESS, task) < 0:
            yield f"nice {os.getpriority(os.PRIO_PROCESS, task)}"
    if os.readlink(f"/proc/{pid}/root") != "/":
        yield "another root directory"
    if int(Path(f"/proc/{pid}/oom_score_adj").read_text()) < 0:
        yield "an OOM score below zero"
    login = Path(f"/proc/{pid}/loginuid").read_text()
    if int(login) not in (uid, int(Path("/proc/self/loginuid").read_text())):
        yield f"the login of {login}"
    for name, hard in hard_limits(pid).items():
        if hard > (0 if "priority" in name else ceilings[name]):
            yield f"{name} {hard}"
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        about, told = descriptor.stat(), Path(f"/proc/{pid}/fdinfo/{descriptor.name}").read_text()
        wanted = {os.O_RDONLY: 0o4, os.O_WRONLY: 0o2}.get(int(procfs.parse_fields(told)["flags"], 8) & os.O_ACCMODE, 0o6)
        if os.readlink(descriptor).startswith(f"/proc/{os.getpid()}/"):
            yield f"{os.readlink(descriptor)} is open"
        if about.st_uid != uid and about.st_mode & wanted != wanted and stat.S_IFMT(about.st_mode):
            yield f"{os.readlink(descriptor)} is open, which is of uid {about.st_uid}, mode {about.st_mode:o}"


def hard_limits(pid: int) -> dict[str, float]:
    """The hard limits of a process, by name."""
    lines = Path(f"/proc/{pid}/limits").read_text().splitlines()[1:]
    return {line[:26].strip(): float(line[47:68].strip().replace("unlimited", "inf")) for line in lines}


def with_credentials(honest: Snapshot, **changed: Any) -> Snapshot:
    return with_process(honest, credentials=replace(honest.process.credentials, **changed))


def with_process(honest: Snapshot, **changed: Any) -> Snapshot:
    return replace(honest, process=replace(honest.process, **changed))


def with_thread(honest: Snapshot, **changed: Any) -> Snapshot:
    return replace(honest, threads=(replace(honest.threads[0], **changed), *honest.threads[1:]))


def with_limit(honest: Snapshot, number: int, hard: int) -> Snapshot:
    return with_process(honest, limits={**honest.process.limits, number: (0, hard)})


def with_resource(honest: Snapshot, kind: str, **facts: Fact) -> Snapshot:
    held = Resource(kind, "crafted", {"descriptors": [], **facts})
    return replace(honest, resources=(*honest.resources, held))


def with_file(honest: Snapshot, path: str, flags: int, kind: str = "files") -> Snapshot:
    about = os.stat(path)
    facts: dict[str, Fact] = {
        "path": path,
        "flags": flags,
        "offset": 0,
        "size": about.st_size,
        "mode": about.st_mode,
        "digest": b"",
    }
    facts |= {"device": about.st_dev, "inode": about.st_ino, "mtime_ns": about.st_mtime_ns}
    if kind == "kernel_files":
        facts = {"path": path, "flags": flags, "offset": 0}
    return with_resource(honest, kind, **facts, descriptors=[[9, 0]])


def ordinary(honest: Snapshot) -> Snapshot:
    """The same program as its owner would have run it."""
    return replace(honest, process=replace(honest.process, credentials=Credentials((OWNER,) * 4, (NO_GROUP,) * 4)))


Craft = Callable[[Snapshot], Snapshot]
CAPABLE = (0, ALL_OF_THEM, ALL_OF_THEM, ALL_OF_THEM, 0)
GONE: Mapping[str, Fact] = {
    "descriptors": [[9, 0]], "path": "/var/tmp/gone", "flags": os.O_RDWR, "offset": 0, "size": 4, "mode": 0o104755, "device": 1,
    "inode": 2, "deleted": True, "content": [[0, b"code"]], "uid": 0, "gid": 0, "attributes": {"security.capability": b"all"},
}  # fmt: skip
"""Of root's, set-user-ID."""
ASKED: Mapping[str, tuple[Craft, str]] = {
    "uids": (lambda one: one, "uid 0"),
    "one saved uid": (lambda one: with_credentials(ordinary(one), uids=(OWNER, OWNER, 0, OWNER)), "uid 0"),
    "one uid for files": (lambda one: with_credentials(ordinary(one), uids=(OWNER, OWNER, OWNER, 0)), "uid 0"),
    "another user's": (lambda one: with_credentials(ordinary(one), uids=(OTHER,) * 4), f"uid {OTHER}"),
    "gids": (lambda one: with_credentials(ordinary(one), gids=(0,) * 4), "gid 0"),
    "one saved gid": (lambda one: with_credentials(ordinary(one), gids=(NO_GROUP, NO_GROUP, 42, NO_GROUP)), "gid 42"),
    "groups": (lambda one: with_credentials(ordinary(one), groups=(0, 6, 42)), "gid 0, 6, 42"),
    "all capabilities": (lambda one: with_credentials(ordinary(one), capabilities=CAPABLE), f"capabilities {ALL_OF_THEM:#x}"),
    "permitted": (lambda one: with_credentials(ordinary(one), capabilities=(0, SYS_ADMIN, 0, ALL_OF_THEM, 0)), "capabilities"),
    "inheritable": (
        lambda one: with_credentials(ordinary(one), capabilities=(SYS_ADMIN, 0, 0, ALL_OF_THEM, 0)),
        f"inheritable capabilities {SYS_ADMIN:#x}",
    ),
    "ambient": (
        lambda one: with_credentials(ordinary(one), capabilities=(SYS_ADMIN,) * 5),
        f"capabilities {SYS_ADMIN:#x}",
    ),
    "securebits": (lambda one: with_credentials(ordinary(one), securebits=0b101111), "securebits 0x2f"),
    "rights of a thread": (
        lambda one: with_resource(
            ordinary(one),
            credentials.KIND,
            threads=[[one.threads[0].tid, [0] * 4, [0] * 4, [0], list(CAPABLE), False]],
        ),
        "uid 0",
    ),
    "nice": (lambda one: with_thread(ordinary(one), nice=-20), "nice -20"),
    "SCHED_FIFO": (lambda one: with_thread(ordinary(one), policy=1, priority=99), "scheduling policy 1 with priority 99"),
    "SCHED_DEADLINE": (
        lambda one: with_resource(
            with_thread(ordinary(one), policy=6),
            "deadlines",
            threads=[[one.threads[0].tid, 6, 0, 10_000_000, 100_000_000, 100_000_000]],
        ),
        "scheduling policy 6",
    ),
    "I/O priority": (lambda one: with_thread(ordinary(one), io_priority=1 << 13), "I/O priority of real time"),
    "OOM score": (lambda one: with_process(ordinary(one), oom_score_adj=-1000), "oom_score_adj -1000"),
    "limit of nice": (lambda one: with_limit(ordinary(one), resource.RLIMIT_NICE, 40), "RLIMIT_NICE 40"),
    "limit of real time": (lambda one: with_limit(ordinary(one), resource.RLIMIT_RTPRIO, -1), "RLIMIT_RTPRIO unlimited"),
    "limit of files": (lambda one: with_limit(ordinary(one), resource.RLIMIT_NOFILE, 1 << 30), "limit 7 is"),
    "limit of locked memory": (lambda one: with_limit(ordinary(one), resource.RLIMIT_MEMLOCK, -1), "limit 8 is"),
    "root directory": (lambda one: with_process(ordinary(one), root_directory="/usr"), "a root directory of its own"),
    "login": (lambda one: with_resource(ordinary(one), "logins", user=OTHER, session=1), f"the login of uid {OTHER}"),
    "working directory": (lambda one: with_process(ordinary(one), working_directory="/root"), "Permission denied"),
    "a file to read": (lambda one: with_file(ordinary(one), "/etc/shadow", os.O_RDONLY), "/etc/shadow"),
    "a file to write": (lambda one: with_file(ordinary(one), "/etc/passwd", os.O_RDWR), "/etc/passwd"),
    "a file of the kernel": (
        lambda one: with_file(ordinary(one), "/proc/sys/kernel/core_pattern", os.O_WRONLY, "kernel_files"),
        "core_pattern",
    ),
    "a view of another process": (
        lambda one: with_file(ordinary(one), f"/proc/{os.getpid()}/maps", os.O_RDONLY, "kernel_files"),
        "Permission denied",
    ),
    "memory of another process": (lambda one: with_file(ordinary(one), "/proc/1/mem", os.O_RDWR, "kernel_files"), "/proc/1/mem"),
    "executable": (
        lambda one: with_process(
            ordinary(one), executable=replace(one.process.executable, path="/etc/shadow", digest=b"", size=0)
        ),
        "/etc/shadow",
    ),
    "a deleted file of root's": (
        lambda one: with_resource(ordinary(one), "files", **GONE),
        "uid 0",
    ),
    "a PID": (lambda one: with_thread(with_process(ordinary(one), pid=1), tid=1), ""),
    "a session": (lambda one: with_process(ordinary(one), sid=1, pgid=1, ppid=1), ""),
    "a signal at the parent's death": (lambda one: with_process(ordinary(one), parent_death_signal=17), ""),
    "dumpable": (lambda one: with_process(ordinary(one), dumpable=2), ""),
    "personality": (lambda one: with_process(ordinary(one), personality=0x0040000), ""),
    "kept capabilities": (lambda one: with_process(ordinary(one), keep_caps=True), ""),
    "a real-time timer slack": (lambda one: with_thread(ordinary(one), timer_slack_ns=1), ""),
    "PIDs of its own": (lambda one: with_process(with_credentials(one), isolated=True), "uid 0"),
}
"""What a file may ask for; a part of what is said of it, "" where no more than its owner's right is asked for."""


@pytest.mark.sampled(2)
@pytest.mark.parametrize("field", ASKED)
def test_root_gives_a_users_file_that_users_rights_at_most_and_says_what_it_asked_for(
    field: str, honest: Snapshot, place: Path
) -> None:
    craft, said = ASKED[field]
    with restored(written(craft(honest), place / "file")) as back:
        assert back.pid or back.ran.returncode == 1
        assert [one for pid in back.pids for one in more_than(OWNER, pid)] == []
        assert said in back.notes + back.error, back.notes + back.error


@pytest.mark.sampled(2)
@pytest.mark.parametrize("field", ASKED)
def test_an_ordinary_user_gets_by_no_file_more_than_he_has(field: str, honest: Snapshot, place: Path) -> None:
    craft, _ = ASKED[field]
    with restored(written(craft(honest), place / "file"), uid=OWNER) as back:
        assert back.pid or back.ran.returncode == 1
        found = [one for pid in back.pids for one in more_than(OWNER, pid)]
        assert [one for one in found if not one.startswith("the login")] == [], "who belongs to no login may choose one"


ROOTS_TO_GIVE = ("nice", "policy", "an OOM score", "Max ", "the login")
"""What root gives to ordinary programs while they run, and what an agent gives back (`restore_limits`)."""


def given_by_an_agent(crafted: Snapshot, file: Path) -> list[str]:
    """What an agent of root gives an ordinary owner's component above what that owner, or root while it ran, could give it."""
    try:
        check_rights("/lab/r1/mapper", crafted, OWNER, Inheritance(OWNER, NO_GROUP))
    except CheckpointError:
        return []
    null = os.open(os.devnull, os.O_RDWR)
    source = os.open(written(crafted, file, 0), os.O_RDONLY)
    isolate = crafted.process.isolated
    with contextlib.ExitStack() as held:
        held.callback(os.close, null)
        held.callback(os.close, source)
        held.enter_context(contextlib.suppress(CheckpointError))
        born = spawn_vessel(Birth(crafted.process.pid, isolate, crafted.clocks if isolate else None, stdio=(null, null, null)))
        held.callback(discard, born)
        with Keeper.spawn() as keeper:
            keeper.ask(Restore(born.pid, "/lab/r1/mapper", own_eyes=True, follow=False), Restored, (source,))
            keeper.ask(Resume(), Resumed)
            return [one for one in more_than(OWNER, born.pid) if not one.startswith(ROOTS_TO_GIVE)]
    return []


@pytest.mark.sampled(2)
@pytest.mark.parametrize("field", ASKED)
def test_an_agent_of_root_gives_an_ordinary_owners_component_nothing_above_him(field: str, honest: Snapshot, place: Path) -> None:
    """What a standby was sent is refused (`check_rights`), or comes back with its owner's rights."""
    assert given_by_an_agent(ASKED[field][0](honest), place / "file") == []


@pytest.mark.parametrize("words", [("--trust",), ()])
def test_who_is_trusted_gets_what_the_file_asks_for(words: tuple[str, ...], honest: Snapshot, place: Path) -> None:
    """With --trust a user's file, without it a file of root's own."""
    crafted = with_credentials(with_thread(honest, nice=-7), gids=(0, 0, 7, 0), groups=(0, 6, 42))
    with restored(written(crafted, place / "file", OWNER if words else 0), *words) as back:
        status = procfs.status(back.pid)
        assert (status.uids, status.gids, status.groups) == ((0,) * 4, (0, 0, 7, 0), (0, 6, 42))
        assert status.capabilities[1] == ALL_OF_THEM & status.capabilities[3]
        assert os.getpriority(os.PRIO_PROCESS, back.pid) == -7
        assert "no more" not in back.notes


def test_what_asks_for_no_more_than_its_owner_has_is_not_talked_about(honest: Snapshot, place: Path) -> None:
    with restored(written(ordinary(honest), place / "file")) as back:
        assert back.pid == honest.process.pid, "root keeps the PID for its owner"
        assert "asks for" not in back.notes


def test_the_groups_are_those_of_the_owners_account(honest: Snapshot, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = replace(honest.process.credentials, gids=(6, 6, 6, 6), groups=(0, 6, 7))
    left = credentials.at_most(asked, Owner(OWNER, 5, (5, 6)))
    assert (left.uids, left.gids, left.groups) == ((OWNER,) * 4, (6,) * 4, (6,))
    assert credentials.at_most(replace(asked, gids=(0,) * 4), Owner(OWNER, 5, (5, 6))).gids == (5,) * 4
    assert file_author.account_of(0).groups is not None
    assert file_author.account_of(OWNER) == Owner(OWNER, NO_GROUP, ())


@pytest.mark.parametrize("trusted", [False, True])
def test_each_process_of_several_and_each_thread_has_its_owners_rights_at_most(trusted: bool, place: Path) -> None:
    several = taken(["/bin/sh", "-c", "sleep 1001 & sleep 1002 & wait"], place / "several")

    def craft(one: Member) -> Member:
        return replace(one, threads=tuple(replace(thread, nice=-5) for thread in one.threads))

    crafted = replace(several, members=tuple(map(craft, several.members)))
    with restored(written(crafted, place / "file"), *(["--trust"] if trusted else [])) as back:
        assert len(set(back.pids)) == 3
        assert {procfs.status(pid).uids[1] for pid in back.pids} == {0 if trusted else OWNER}
        assert trusted or [one for pid in back.pids for one in more_than(OWNER, pid)] == []


def carrying(honest: Snapshot, path: Path) -> Snapshot:
    """With a program of root's, set-user-ID, that is to be laid down at a path."""
    mark = b"\1\0\0\2" + bytes.fromhex("ffffffff") + bytes(12)
    entry = Entry(
        b"", stat.S_IFREG | 0o4755, 0, 0, 1, place=0, attributes=(("security.capability", mark), ("user.colour", b"red"))
    )
    crafted = ordinary(honest)
    return replace(crafted, resources=(*crafted.resources, Tree(str(path), (entry,)).resource()))


def test_files_that_travel_with_it_are_laid_down_with_the_owners_rights_and_through_no_link(
    honest: Snapshot, place: Path
) -> None:
    theirs, ours = place / "theirs", place / "ours"
    for folder in (theirs, ours):
        folder.mkdir()
    (theirs / "link").symlink_to(ours)
    os.chown(theirs, OWNER, OWNER)
    for path in (ours / "program", theirs / "link" / "program", Path("/etc/cron.d/crafted")):
        with restored(written(carrying(honest, path), place / "file")) as back:
            assert (back.pid, back.ran.returncode) == (0, 1)
            assert "Permission denied" in back.error, back.error
            assert not path.exists()
    with restored(written(carrying(honest, theirs / "program"), place / "file")) as back:
        assert back.pid, back.error
        about = (theirs / "program").stat()
        assert (about.st_uid, about.st_gid) == (OWNER, NO_GROUP)
        assert "security.capability" not in os.listxattr(theirs / "program")


def at_a_terminal(words: list[str]) -> tuple[int, str]:
    """Run the command in a session of its own at a new terminal: our end of that, and what the command has written there."""
    ours, theirs = pty.openpty()

    def sit_down() -> None:
        os.setsid()
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)

    command = [sys.executable, "-m", "failover", *words]
    with subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, preexec_fn=sit_down) as ran:
        os.close(theirs)
        said = ""
        while not said.strip().partition("\n")[0].strip().isdigit() and ran.poll() is None:
            said += os.read(ours, 4096).decode()
    return ours, said


@pytest.mark.parametrize("trusted", [False, True])
def test_a_users_program_that_root_brings_back_reads_nothing_that_is_typed_at_roots_terminal(trusted: bool, place: Path) -> None:
    seen, terminal = pty.openpty()

    def sit_down() -> None:
        os.setsid()
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)

    words = ["sleep", "1000"]
    with subprocess.Popen(words, cwd="/", stdin=terminal, stdout=terminal, stderr=terminal, preexec_fn=sit_down) as program:
        ran = failover("capture", str(program.pid), "-o", str(place / "file"))
        program.kill()
    assert ran.returncode == 0, ran.stderr
    os.chown(place / "file", OWNER, OWNER)
    ours, said = at_a_terminal(["restore", *(["--trust"] if trusted else []), str(place / "file")])
    pid = int(said.split()[0])
    try:
        fields = procfs.parse_fields(Path(f"/proc/{pid}/fdinfo/0").read_text())
        assert int(fields["flags"], 8) & os.O_ACCMODE == (os.O_RDWR if trusted else os.O_WRONLY)
        assert os.readlink(f"/proc/{pid}/fd/1").startswith("/dev/pts/")
        assert procfs.status(pid).uids[1] == (0 if trusted else OWNER)
    finally:
        os.kill(pid, signal.SIGKILL)
        wait_for("its end", lambda: has_ended(pid))
        for descriptor in (ours, seen, terminal):
            os.close(descriptor)


def test_inspect_says_with_which_rights_it_comes_back(honest: Snapshot, place: Path) -> None:
    file = written(with_thread(honest, nice=-20), place / "file")
    told = json.loads(failover("inspect", "--json", str(file)).stdout)["rights"]
    assert told["author"] == OWNER and {"uid 0", "gid 0", "nice -20"} <= set(told["reduced"])
    shown = failover("inspect", str(file)).stdout
    assert f"those of uid {OWNER} at most" in shown and "nice -20" in shown
    os.chown(file, 0, 0)
    assert "all that it asks for" in failover("inspect", str(file)).stdout
    file.chmod(0o666)
    assert "refused: " in failover("inspect", str(file)).stdout


# --- Whose word a file is ----------------------------------------------------------------------------------------------


def judged(path: Path | str, file: Path | None = None) -> int | None:
    """The uid of whose word the file at a path is; None: the path does not tell.

    Args:
        file: to which the path leads, where a kernel with `fs.protected_symlinks` does not follow it.
    """
    descriptor = os.open(file or path, os.O_RDONLY)
    try:
        owner = file_author.author_of(descriptor, str(path)).owner
        return owner.uid if owner is not None else 0
    except AuthorError:
        return None
    finally:
        os.close(descriptor)


@pytest.fixture
def file(place: Path) -> Path:
    (place / "file").write_bytes(b"content")
    (place / "file").chmod(0o600)
    return place / "file"


@pytest.mark.parametrize(
    ("owner", "mode", "expected"),
    [(0, 0o600, 0), (0, 0o644, 0), (OWNER, 0o600, OWNER), (0, 0o620, None), (0, 0o602, None), (OWNER, 0o666, None)],
)
def test_owner_and_mode_of_the_file_itself_count(file: Path, owner: int, mode: int, expected: int | None) -> None:
    os.chown(file, owner, owner)
    file.chmod(mode)
    assert judged(file) == expected


@pytest.mark.parametrize(
    ("owner", "mode", "expected"),
    [(OWNER, 0o755, OWNER), (OWNER, 0o555, OWNER), (0, 0o777, None), (0, 0o775, None), (0, 0o1777, 0), (OWNER, 0o1777, OWNER)],
)
def test_who_may_put_another_file_of_roots_there_has_chosen_it(place: Path, owner: int, mode: int, expected: int | None) -> None:
    folder = place / "folder"
    folder.mkdir()
    (folder / "file").write_bytes(b"content")
    os.chown(folder, owner, owner)
    folder.chmod(mode)
    assert judged(folder / "file") == expected


def test_who_made_a_link_has_chosen_what_it_leads_to(place: Path, file: Path) -> None:
    shared = place / "shared"
    shared.mkdir()
    shared.chmod(0o1777)
    for name, owner in (("of-root", 0), ("of-user", OWNER)):
        (shared / name).symlink_to(file)
        os.chown(shared / name, owner, owner, follow_symlinks=False)
    (place / "outer").symlink_to("shared/of-user")
    assert judged(shared / "of-root") == 0
    assert judged(shared / "of-user", file) == judged(place / "outer", file) == OWNER
    folder = place / "of-another"
    folder.mkdir()
    os.chown(folder, OTHER, OTHER)
    (folder / "link").symlink_to(shared / "of-user")
    assert judged(folder / "link", file) is None, "two users chose"
    os.link(file, shared / "named-again")
    assert judged(shared / "named-again") is None, "anybody may have made that name"


def test_a_path_is_followed_as_the_kernel_does(place: Path, file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    theirs = place / "theirs"
    theirs.mkdir()
    os.chown(theirs, OWNER, OWNER)
    monkeypatch.chdir(place)
    assert judged("file") == judged("./file") == 0
    assert judged("theirs/../file") == 0, "whoever owns a directory cannot choose what is above it"
    (theirs / "link").symlink_to("../file")
    assert judged("theirs/link") == OWNER
    descriptor = os.open(file, os.O_RDONLY)
    assert judged(f"/proc/self/fd/{descriptor}") == 0
    os.close(descriptor)


def test_who_has_a_file_open_for_writing_is_not_done_with_it_by_a_change_of_owner(file: Path) -> None:
    with file.open("ab") as held:
        assert judged(file) is None
        assert held.writable()
    assert judged(file) == 0


def test_what_has_no_owner_is_nobodys_word(place: Path, file: Path) -> None:
    read_end, write_end = os.pipe()
    assert judged(f"/proc/self/fd/{read_end}") is None
    os.close(read_end)
    os.close(write_end)
    os.mkfifo(place / "fifo")
    ran = failover("restore", str(place / "fifo"))
    assert ran.returncode == 1 and "no regular file" in ran.stderr
    descriptor = os.open(file, os.O_RDONLY)
    file.unlink()
    assert judged(f"/proc/self/fd/{descriptor}") is None
    os.close(descriptor)


def test_owners_on_a_mount_without_set_user_id_prove_nothing(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(file_author.mounts, "type_of_mount", lambda pid, path: "fuse.sshfs")
    assert judged(file) == 0
    real = os.fstatvfs

    class Seen:
        f_flag = os.ST_NOSUID

    monkeypatch.setattr(os, "fstatvfs", lambda descriptor: Seen() if descriptor else real(descriptor))
    assert judged(file) is None
    monkeypatch.setattr(file_author.mounts, "type_of_mount", lambda pid, path: "tmpfs")
    assert judged(file) == 0


def test_a_restore_by_a_file_that_anybody_may_write_to_starts_nothing(honest: Snapshot, place: Path) -> None:
    with restored(written(ordinary(honest), place / "file", mode=0o666)) as back:
        assert (back.ran.returncode, back.pid) == (1, 0)
        assert "mode 666" in back.error and "--trust" in back.error


# --- Any field, by chance ----------------------------------------------------------------------------------------------

HOSTILE: tuple[Any, ...] = (
    0,
    1,
    -1,
    2,
    99,
    1 << 31,
    -(1 << 31),
    (1 << 62),
    "",
    "/",
    "/etc/shadow",
    "../..",
    "\0",
    "/proc/1/root",
    b"",
)
UNTOUCHED = frozenset({"machine", "clocks", "vmas", "layout", "registers", "runs", "contents", "position", "engine"})
"""What has no authority of its own, or is told to be wrong before anything else is looked at."""


def mutated(value: Any, chance: random.Random) -> Any:
    """One leaf of a document changed to something hostile of its own type, or of any."""
    if isinstance(value, dict) and (names := [name for name in value if name not in UNTOUCHED]):
        name = chance.choice(names)
        return value | {name: mutated(value[name], chance)}
    if isinstance(value, list) and value:
        place = chance.randrange(len(value))
        return [*value[:place], mutated(value[place], chance), *value[place + 1 :]]
    same = [one for one in HOSTILE if type(one) is type(value)]
    if isinstance(value, bool):
        return not value
    return chance.choice(same if same and chance.random() < 0.8 else list(HOSTILE))


def crafted_by_chance(honest: Snapshot, chance: random.Random) -> Snapshot | None:
    """A snapshot that the encoder writes; None: a value is not of a field's type, and no file can say it."""
    told = msgspec.msgpack.decode(encode_state(honest))
    for _ in range(chance.choice((1, 1, 2, 5))):
        part = chance.choice(("process", "process", "threads", "resources"))
        told[part] = mutated(told[part], chance)
    try:
        state = decode_state(msgspec.msgpack.encode(told))
        crafted = replace(honest, process=state.process, threads=state.threads, resources=state.resources)
        format.encode_bytes(replace(crafted, position=position_of(crafted, 1, 1)))
    except CheckpointError:
        return None
    return crafted


@pytest.mark.parametrize("seed", range(SEEDS))
def test_whatever_a_file_says_no_more_rights_come_of_it_and_no_traceback(seed: int, honest: Snapshot, place: Path) -> None:
    chance = random.Random(seed)
    found = 0
    while found < CRAFTED_A_SEED:
        crafted = crafted_by_chance(with_sample_resources(honest), chance)
        if crafted is None:
            continue
        found += 1
        uid = chance.choice((0, 0, OWNER))
        with restored(written(crafted, place / f"file-{found}"), uid=uid) as back:
            assert back.pid or back.error, back.ran
            more = [one for pid in back.pids for one in more_than(OWNER, pid) if not (uid and one.startswith("the login"))]
            assert more == [], (seed, found)


@pytest.mark.parametrize("seed", range(SEEDS // 2))
def test_whatever_a_peer_sends_an_agent_gives_no_more_than_the_owner_has(seed: int, honest: Snapshot, place: Path) -> None:
    chance = random.Random(-1 - seed)
    told = with_file(ordinary(honest), "/proc/self/status", os.O_RDONLY, "kernel_files")
    for found in range(CRAFTED_A_SEED):
        if crafted := crafted_by_chance(told, chance):
            assert given_by_an_agent(crafted, place / f"file-{found}") == [], (seed, found)


def with_sample_resources(honest: Snapshot) -> Snapshot:
    """With something of the kinds that have rights to tell of."""
    thread: list[Fact] = [honest.threads[0].tid, [0] * 4, [0] * 4, [0], list(CAPABLE), False]
    told = with_resource(with_resource(honest, credentials.KIND, threads=[thread]), "logins", user=OWNER, session=1)
    return with_file(told, "/proc/self/status", os.O_RDONLY, "kernel_files")
