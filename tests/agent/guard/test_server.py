"""The real guard, over its real socket: which processes end when others die, and what they leave."""

from __future__ import annotations

import array
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from agent.guard.messages import (
    Commit,
    Describe,
    Described,
    Done,
    Exited,
    Forget,
    Freeze,
    FrozenByLease,
    Kill,
    Lease,
    LetGo,
    MakeVessel,
    Refused,
    Thaw,
    VesselReady,
    Watch,
)
from agent.system.clock import now_ns
from checkpoint.keeper import messages
from checkpoint.linux import realtime_boost
from checkpoint.linux.unix_address import PATH_SIZE_MAX
from checkpoint.model import Clocks
from tests.agent.guards import PYTHON, GuardProcess, guarding, lives, until

LINES = 100_000
SOON_NS = 30_000_000
"""How far ahead a lease ends that a test waits for."""

FAR_NS = 3_600_000_000_000

SLEPT_S = 100_000
SLEPT = ("unshare", "--time", f"--boottime={SLEPT_S}", "--fork", "--kill-child", "--")

COUNT = "i = 0\nwhile True:\n    print(i, flush=True)\n    i += 1\n    __import__('time').sleep(0.0005)\n"
COUNTING = (PYTHON, "-S", "-c", COUNT)
NO_CGROUP = "/nonexistent"
"""A place where no cgroup can be made: the guard falls back on SIGSTOP."""

ENDINGS = {
    "exits at once": "exit 0",
    "exits with a status": "exit 7",
    "dumps core": "ulimit -c unlimited; kill -QUIT $$",
    "is ended by SIGPIPE": "kill -PIPE $$; echo it is ignored",
    "is killed": "kill -KILL $$",
    "closes its streams first": "exec >&- 2>&-; sleep 0.05; exit 3",
}


@pytest.fixture
def guard(tmp_path: Path) -> Iterator[GuardProcess]:
    with guarding(tmp_path) as process:
        yield process


def undisturbed(script: str, directory: Path) -> int:
    """The wait status of a shell that nobody guards."""
    default = [signal.SIGPIPE, signal.SIGQUIT]
    pid = os.posix_spawn(
        "/bin/sh", ["sh", "-c", f"cd {directory}; exec >/dev/null 2>&1; {script}"], os.environ, setsigdef=default
    )
    return os.waitpid(pid, 0)[1]


def in_ns(ahead: int) -> int:
    """An instant on CLOCK_BOOTTIME."""
    return now_ns() + ahead


def stands_still(guard: GuardProcess) -> bool:
    """Whether the output has stopped to grow: a look, and another after more than any pause of the program."""
    before = guard.output()
    time.sleep(0.02)
    return guard.output() == before


def grows(guard: GuardProcess) -> bool:
    before = len(guard.output())
    return bool(until(lambda: len(guard.output()) > before, "more output"))


# Output and end


def test_a_hundred_thousand_lines_are_whole_and_in_order(guard: GuardProcess) -> None:
    script = f"import sys\nfor i in range({LINES}):\n    print(i, flush=i % 7 == 0)\n    i % 10 or print(-i, file=sys.stderr)"
    agent = guard.agent()
    guard.start(agent, PYTHON, "-S", "-c", script)
    exited = agent.event(Exited)
    lines, errors = guard.output(), guard.output("stderr")
    assert lines.split() == [b"%d" % number for number in range(LINES)]
    assert errors.split() == [b"%d" % -number for number in range(0, LINES, 10)]
    assert (exited.status, exited.totals) == (0, (len(lines), len(errors)))


@pytest.mark.parametrize("way", ENDINGS)
def test_the_wait_status_is_that_of_an_unguarded_program_that(guard: GuardProcess, tmp_path: Path, way: str) -> None:
    agent = guard.agent()
    guard.start(agent, "/bin/sh", "-c", ENDINGS[way])
    exited = agent.event(Exited)
    assert exited.status == undisturbed(ENDINGS[way], tmp_path)
    assert agent.describe().exit_status == exited.status
    assert (guard.output(), guard.output("stderr")) == (b"", b"")


def test_a_core_is_dumped_where_the_program_is_allowed_one(guard: GuardProcess) -> None:
    if resource.getrlimit(resource.RLIMIT_CORE)[1] == 0:
        pytest.skip("no core is dumped here: the hard limit is 0")
    agent = guard.agent()
    guard.start(agent, "/bin/sh", "-c", ENDINGS["dumps core"])
    status = agent.event(Exited).status
    assert status is not None and os.WCOREDUMP(status) and os.WTERMSIG(status) == signal.SIGQUIT


def test_a_program_that_cannot_be_started_is_refused_with_the_reason(guard: GuardProcess) -> None:
    agent = guard.agent()
    refused = agent.ask(guard.order("/no/such/program"))
    assert isinstance(refused, Refused)
    assert "cannot start /no/such/program" in refused.message and "No such file" in refused.message
    refused = agent.ask(guard.order("nosuch.py"))
    assert isinstance(refused, Refused)
    assert refused.message.startswith("cannot start nosuch.py: no directory of its PATH has nosuch.py")
    assert "b'" not in refused.message
    guard.start(agent, "/bin/true")  # and the guard is still of use


def test_the_end_is_told_to_every_agent_until_one_has_noted_it(guard: GuardProcess) -> None:
    first = guard.agent()
    guard.start(first, "/bin/sh", "-c", "echo last; exit 9")
    assert first.event(Exited).status == 9 << 8
    first.close()
    for _ in range(3):
        later = guard.agent()
        assert later.event(Exited) == Exited(9 << 8, (5, 0), later.event(Exited).notes)
        later.close()
    last = guard.agent()
    assert isinstance(last.ask(Forget()), Done)
    assert guard.ended() == 0
    assert not guard.path.exists()


@pytest.mark.parametrize("cgroup", ["", "/nowhere"], ids=["in_a_cgroup_if_we_may", "without_a_cgroup"])
def test_what_the_program_leaves_running_ends_with_it(cgroup: str, guard: GuardProcess) -> None:
    agent = guard.agent()
    guard.start(agent, "/bin/sh", "-c", "sleep 1000 & echo $!; exit 0", cgroup=cgroup)
    agent.event(Exited)
    left = int(guard.output())
    until(lambda: not lives(left), "its child to end")


def test_a_program_that_runs_is_not_forgotten(guard: GuardProcess) -> None:
    agent = guard.agent()
    guard.start(agent, *COUNTING)
    refused = agent.ask(Forget())
    assert isinstance(refused, Refused) and "still runs" in refused.message
    assert grows(guard)


# Whoever else dies


def test_a_program_outlives_its_agent_and_is_found_by_the_next(guard: GuardProcess) -> None:
    agent = guard.agent()
    started = guard.start(agent, *COUNTING)
    agent.close()
    assert grows(guard)
    described = guard.agent().describe()
    assert (described.component, described.pid, described.state) == ("/test/one", started.pid, "running")


def test_the_newest_agent_is_the_one_that_is_heard(guard: GuardProcess) -> None:
    first = guard.agent()
    guard.start(first, *COUNTING)
    second = guard.agent()
    assert second.describe().state == "running"
    assert first.hung_up()
    assert grows(guard)


def test_a_program_does_not_outlive_its_guard(guard: GuardProcess) -> None:
    pid = guard.start(guard.agent(), *COUNTING).pid
    guard.process.kill()
    until(lambda: not lives(pid), "the program to end")


def test_a_guard_ends_when_its_agent_goes_before_anything_was_started(guard: GuardProcess) -> None:
    guard.agent().close()
    assert guard.ended() == 0
    assert not guard.path.exists()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_guard_does_not_end_by_a_signal_of_a_shutdown_before_its_program_has(guard: GuardProcess, number: int) -> None:
    agent = guard.agent()
    guard.start(agent, *COUNTING)
    guard.process.send_signal(number)
    assert agent.describe().state == "running"
    assert grows(guard)


def test_a_shutdown_ends_a_program_and_then_its_guard_when_no_agent_is_left(guard: GuardProcess) -> None:
    agent = guard.agent()
    pid = guard.start(agent, *COUNTING).pid
    guard.process.send_signal(signal.SIGTERM)
    assert agent.describe().state == "running"
    agent.close()
    assert grows(guard)
    os.kill(pid, signal.SIGTERM)
    assert guard.ended() == 0


def vessel(guard: GuardProcess) -> MakeVessel:
    clocks = Clocks(monotonic_ns=0, boottime_ns=0, realtime_ns=0)
    return MakeVessel("/test/one", 0, False, clocks, 0, (0, 0), str(guard.logs))


def test_a_vessel_that_nobody_committed_to_ends_with_its_agent(guard: GuardProcess) -> None:
    agent = guard.agent()
    ready = agent.ask(vessel(guard))
    assert isinstance(ready, VesselReady) and agent.describe().state == "vessel"
    agent.close()
    assert guard.ended() == 0
    assert not lives(ready.pid) and not guard.path.exists()


def test_a_vessel_that_was_committed_to_outlives_its_agent(guard: GuardProcess) -> None:
    agent = guard.agent()
    ready = agent.ask(vessel(guard))
    assert isinstance(agent.ask(Commit()), Done)
    agent.close()
    later = guard.agent()
    assert later.describe().state == "running" and lives(ready.pid)
    assert isinstance(later.ask(Kill(signal.SIGKILL)), Done)
    assert later.event(Exited).status == signal.SIGKILL


@pytest.mark.parametrize("committed", [False, True])
def test_a_vessel_ends_with_its_keeper_as_long_as_nobody_committed_to_it(guard: GuardProcess, committed: bool) -> None:
    agent = guard.agent()
    keeper = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    pidfd = os.pidfd_open(keeper.pid)
    ready = agent.ask(vessel(guard), (pidfd,))
    os.close(pidfd)
    if committed:
        agent.ask(Commit())
    keeper.communicate()
    if committed:
        assert agent.describe().state == "running" and lives(ready.pid)
    else:
        exited = agent.event(Exited)
        assert exited.status == signal.SIGKILL and any("not finished" in note for note in exited.notes)


def test_of_a_vessel_that_ended_before_its_agent_did_nothing_is_left_to_be_found(guard: GuardProcess) -> None:
    agent = guard.agent()
    keeper = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    pidfd = os.pidfd_open(keeper.pid)
    agent.ask(vessel(guard), (pidfd,))
    os.close(pidfd)
    keeper.communicate()
    assert agent.event(Exited).status == signal.SIGKILL
    agent.close()
    assert guard.ended() == 0
    assert not guard.path.exists()


# The lease


@pytest.mark.parametrize("cgroup", ["", NO_CGROUP])
def test_a_lease_that_runs_out_freezes_the_program_until_there_is_another(guard: GuardProcess, cgroup: str) -> None:
    agent = guard.agent()
    guard.start(agent, *COUNTING, cgroup=cgroup)
    assert agent.describe().freezes_by == "SIGSTOP" if cgroup else True
    assert grows(guard)
    agent.ask(Lease(in_ns(SOON_NS)))
    agent.event(FrozenByLease)
    until(lambda: stands_still(guard), "the program to stand still")
    refused = agent.ask(Thaw())
    assert isinstance(refused, Refused) and "its lease is over" in refused.message
    assert agent.describe().frozen_by == "lease"
    agent.ask(Lease(in_ns(FAR_NS)))
    assert agent.describe().state == "running" and grows(guard)


def test_a_lease_needs_no_agent_to_run_out(guard: GuardProcess) -> None:
    agent = guard.agent()
    guard.start(agent, *COUNTING)
    grows(guard)
    over_ns = in_ns(SOON_NS)
    agent.ask(Lease(over_ns))
    agent.close()
    until(lambda: now_ns() > over_ns, "the lease to be over")
    until(lambda: stands_still(guard), "the program to stand still")
    later = guard.agent()
    until(lambda: later.describe().frozen_by == "lease", "its guard to have seen that")
    until(lambda: stands_still(guard), "that a new agent alone thaws nothing")
    assert later.describe().frozen_by == "lease"
    later.ask(Lease(0))
    assert grows(guard)


def test_a_lease_that_runs_out_at_the_instant_at_which_the_agent_dies_hurts_neither_guard_nor_program(
    guard: GuardProcess,
) -> None:
    agent = guard.agent()
    pid = guard.start(agent, *COUNTING).pid
    over_ns = in_ns(SOON_NS)
    agent.ask(Lease(over_ns))
    guard.process.send_signal(signal.SIGSTOP)
    agent.close()
    until(lambda: now_ns() > over_ns, "the lease to be over")
    guard.process.send_signal(signal.SIGCONT)  # and both are news to it in one turn
    assert guard.agent().describe().frozen_by == "lease"
    assert lives(pid)


def test_a_lease_that_is_renewed_in_time_freezes_nothing(guard: GuardProcess) -> None:
    agent = guard.agent()
    guard.start(agent, *COUNTING)
    ahead_ns = SOON_NS
    while True:
        first_ends_ns = in_ns(ahead_ns)
        agent.ask(Lease(first_ends_ns))
        agent.ask(Lease(in_ns(FAR_NS)))
        if now_ns() < first_ends_ns:
            break
        agent.events.clear()  # a busy machine, on which that was too late
        ahead_ns *= 2
    until(lambda: now_ns() > first_ends_ns, "the first lease to have been over")
    assert grows(guard) and agent.describe().state == "running"
    assert not agent.events


@pytest.mark.root
def test_a_lease_counts_the_time_that_the_machine_sleeps(tmp_path: Path) -> None:
    """In a time namespace whose boot time is ahead, as after a sleep: by the monotonic clock the lease would last for hours."""
    with guarding(tmp_path, SLEPT) as guard:
        agent = guard.agent()
        guard.start(agent, *COUNTING)
        agent.ask(Lease(in_ns(SLEPT_S * 1_000_000_000 + SOON_NS)))
        assert agent.event(FrozenByLease)
        until(lambda: stands_still(guard), "what was in its pipe to be written")
        assert agent.describe().frozen_by == "lease"


def test_what_was_frozen_by_order_is_not_thawed_by_a_lease(guard: GuardProcess) -> None:
    agent = guard.agent()
    guard.start(agent, *COUNTING)
    assert isinstance(agent.ask(Freeze()), Done)
    agent.ask(Lease(in_ns(FAR_NS)))
    assert agent.describe().frozen_by == "order"
    until(lambda: stands_still(guard), "what lay in its pipe to be written")
    agent.ask(Thaw())
    assert grows(guard)


def test_a_vessel_is_held_from_its_commit_on_if_its_lease_is_over(guard: GuardProcess) -> None:
    agent = guard.agent()
    agent.ask(vessel(guard))
    agent.ask(Lease(1))
    assert agent.describe().state == "vessel"
    agent.ask(Commit())
    assert agent.describe().frozen_by == "lease"


def state_of(pid: int) -> str:
    """The state letter of a process."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


@pytest.mark.parametrize("by", ["order", "lease"])
@pytest.mark.parametrize("cgroup", ["", NO_CGROUP])
def test_what_is_held_for_a_tracer_stands_by_itself_until_it_is_thawed(guard: GuardProcess, cgroup: str, by: str) -> None:
    agent = guard.agent()
    pid = guard.start(agent, *COUNTING, cgroup=cgroup).pid
    grows(guard)
    if by == "lease":
        agent.ask(Lease(1))
        agent.event(FrozenByLease)
    assert isinstance(agent.ask(Freeze(exposed=True)), Done)
    assert state_of(pid) == "T"
    until(lambda: stands_still(guard), "what lay in its pipe to be written")
    agent.ask(Lease(0))
    until(lambda: stands_still(guard), "that it goes on standing")
    agent.ask(Thaw())
    assert grows(guard)


def test_a_frozen_program_can_be_killed(guard: GuardProcess) -> None:
    agent = guard.agent()
    guard.start(agent, *COUNTING)
    agent.ask(Freeze())
    agent.ask(Kill(signal.SIGKILL))
    assert agent.event(Exited).status == signal.SIGKILL


# Letting go, and looking after somebody else's child


def test_a_program_that_was_let_go_is_found_by_nobody_and_its_guard_ends_with_it(guard: GuardProcess, tmp_path: Path) -> None:
    agent = guard.agent()
    guard.start(agent, "/bin/sh", "-c", "echo before; until [ -e go ]; do sleep 0.01; done; echo after")
    agent.ask(Lease(in_ns(SOON_NS)))
    agent.ask(LetGo())
    agent.close()
    assert not guard.path.exists()
    (tmp_path / "go").touch()
    assert guard.ended() == 0
    assert guard.output() == b"before\nafter\n"


def test_below_a_path_that_no_address_holds_a_program_is_let_go_as_anywhere(tmp_path: Path) -> None:
    place = tmp_path / ("d" * PATH_SIZE_MAX)
    place.mkdir()
    with guarding(place) as guard:
        agent = guard.agent()
        guard.start(agent, "/bin/sh", "-c", "until [ -e go ]; do sleep 0.01; done; echo after")
        assert agent.ask(LetGo()) == Done()
        agent.close()
        assert not guard.path.exists()
        (place / "go").touch()
        assert guard.ended() == 0
        assert guard.output() == b"after\n"


def test_a_guard_comes_before_keepers_that_hold_programs_still(guard: GuardProcess) -> None:
    """Its lease runs out on the instant, whatever a keeper is copying on the same processor."""
    described = guard.agent().ask(Describe())
    assert isinstance(described, Described)
    pid = guard.process.pid
    if os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK != os.SCHED_FIFO:
        pytest.skip("no real-time priority here")
    is_told = any("the guard has real-time priority 1" in note for note in described.notes)
    assert is_told or os.sched_getparam(pid).sched_priority > realtime_boost.PRIORITY


def test_the_end_of_somebody_elses_child_is_noticed_without_its_status(guard: GuardProcess) -> None:
    agent = guard.agent()
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    assert isinstance(agent.ask(Watch("/test/one", child.pid)), Refused), "its number alone may be another process's"
    pidfd = os.pidfd_open(child.pid)
    agent.ask(Watch("/test/one", child.pid), (pidfd,))
    os.close(pidfd)
    child.communicate()
    assert agent.event(Exited).status is None


# What makes no sense


def memfd_packet_without_a_memfd(end: socket.socket) -> None:
    end.send(messages.IN_MEMFD)


def a_message_of_nobody(end: socket.socket) -> None:
    end.send(messages.INLINE + b"\x81\xa4type\xa7Unknown")


def noise(end: socket.socket) -> None:
    end.send(bytes(range(256)))


def a_message_that_is_too_long(end: socket.socket) -> None:
    end.send(bytes(messages.INLINE_LIMIT + 2))


def noise_with_descriptors(end: socket.socket) -> None:
    with open("/dev/null", "rb") as file:
        end.sendmsg([b"\xff"], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", [file.fileno()] * 3))])


NONSENSE = (memfd_packet_without_a_memfd, a_message_of_nobody, noise, a_message_that_is_too_long, noise_with_descriptors)


def test_an_agent_that_talks_nonsense_is_cut_off_and_the_program_runs_on(guard: GuardProcess) -> None:
    agent = guard.agent()
    guard.start(agent, *COUNTING)
    open_before = len(os.listdir(f"/proc/{guard.process.pid}/fd"))
    for speak in NONSENSE:
        speak(agent.end)
        assert agent.hung_up(), speak.__name__
        agent = guard.agent()
        assert agent.describe().state == "running", speak.__name__
    assert grows(guard)
    assert len(os.listdir(f"/proc/{guard.process.pid}/fd")) == open_before


def test_what_does_not_fit_the_state_is_refused_in_a_sentence(guard: GuardProcess) -> None:
    agent = guard.agent()
    for early in (Lease(0), Freeze(), Thaw(), Kill(15), Commit(), LetGo()):
        assert agent.ask(early) == Refused("nothing was started yet")
    guard.start(agent, "/bin/true")
    again = agent.ask(guard.order("/bin/true"))
    assert isinstance(again, Refused) and "a guard serves one program only" in again.message
    agent.event(Exited)
    for late in (Freeze(), Thaw(), Commit()):
        refused = agent.ask(late)
        assert isinstance(refused, Refused) and "has ended" in refused.message
    assert isinstance(agent.ask(Kill(signal.SIGKILL)), Done), "a signal to what has ended hurts nobody"


def test_a_path_that_is_taken_is_said(guard: GuardProcess) -> None:
    guard.agent()
    second = subprocess.run(
        [sys.executable, "-m", "agent.guard.server", str(guard.path)], capture_output=True, text=True, check=False
    )
    assert second.returncode == 1 and "Address already in use" in second.stderr
    assert guard.path.exists(), "it is the first one's"
