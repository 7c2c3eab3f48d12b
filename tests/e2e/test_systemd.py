"""The agent as a service of a real systemd that is PID 1, with the units as they are shipped; its components outlive it."""

from __future__ import annotations

import json
import os
import re
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e import machines, robots
from tests.e2e.machines import Machine
from tests.e2e.service import SERVICE, component, control, counted, install, make_team, started, status

pytestmark = [
    pytest.mark.root,
    pytest.mark.slow,
    pytest.mark.skipif(bool(machines.why_not()), reason=machines.why_not() or "-"),
]

MORE = 20
EXPOSURE_MAX = 30
"""In tenths, as systemd-analyze(1) takes it: from 0, shut in, to 100, exposed; a plain service has 96."""


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """A robot with the service installed as the guide says, and started."""
    with machines.booted(tmp_path_factory.mktemp("machines"), "robot1") as booted:
        install(booted)
        make_team(booted, robot1="127.0.0.1")
        booted.run("systemctl", "start", SERVICE)
        yield booted
        print(booted.run("journalctl", "--unit", SERVICE, "--no-pager", "--lines=100", check=False).stdout)


def expect_it_to_count_on(machine: Machine, name: str, pid: int) -> None:
    """The agent has found it again, it is the same process, and its output has no gap."""
    robots.until(lambda: component(machine, name).get("pid") == pid, "the agent to find its component again")
    assert component(machine, name)["restores"] == 0
    before = len(counted(machine, name))
    robots.until(lambda: len(counted(machine, name)) > before + MORE, "the count to go on")
    numbers = counted(machine, name)
    assert numbers == list(range(len(numbers)))


def main_pid(machine: Machine) -> int:
    return int(machine.property(SERVICE, "MainPID"))


def test_the_units_are_right(machine: Machine) -> None:
    said = machine.run("systemd-analyze", "verify", f"/etc/systemd/system/{SERVICE}", "/etc/systemd/system/failover.slice")
    assert not said.stderr


def test_the_service_is_ready_when_it_protects(machine: Machine) -> None:
    assert machine.property(SERVICE, "ActiveState") == "active"
    assert machine.property(SERVICE, "StatusText") == "protecting this robot and its neighbours"
    assert json.loads(machine.run("failover", "status", "--json").stdout)["robot"] == "robot1"


def test_the_beats_have_real_time_priority_where_this_machine_may_give_it(machine: Machine) -> None:
    """The unit asks for it; a systemd that may not raise limits itself gives less, and the status says so."""
    assert [machine.property(SERVICE, name) for name in ("LimitRTPRIO", "LimitMEMLOCK")] == ["99", "infinity"]
    limits = machine.run("cat", f"/proc/{main_pid(machine)}/limits").stdout
    may_come_first = re.search(r"^Max realtime priority +99 ", limits, re.MULTILINE) is not None
    may_stay = re.search(r"^Max locked memory +unlimited ", limits, re.MULTILINE) is not None
    told = status(machine)
    assert told["realtime"] == (may_come_first and may_stay)
    assert any("the system refused SCHED_FIFO" in note for note in told["notes"]) == (not may_come_first)
    assert any("can be swapped out" in note for note in told["notes"]) == (not may_stay)


def test_the_service_is_shut_in_and_has_no_capability(machine: Machine) -> None:
    machine.run("systemd-analyze", "security", f"--threshold={EXPOSURE_MAX}", SERVICE)
    for pid in (main_pid(machine), status(machine)["lanes_pid"]):
        assert "CapEff:\t0000000000000000" in standing(machine, pid) and "Seccomp:\t2" in standing(machine, pid)


def test_its_guards_and_programs_inherit_nothing_of_that(machine: Machine) -> None:
    program = started(machine, "free")
    guard = next(int(line[6:]) for line in standing(machine, program) if line.startswith("PPid:"))
    for pid in (program, guard):
        (everything,) = (line for line in standing(machine, 1) if line.startswith("CapBnd:"))
        assert {everything, "Seccomp:\t0", "NoNewPrivs:\t0"} <= set(standing(machine, pid))
        assert not {"Gid:\t" + "\t".join([group(machine)] * 4)} & set(standing(machine, pid))
    assert (machine.root / f"proc/{program}/oom_score_adj").read_text() == "0\n"
    assert set(machine.property("failover-guard-*", "OOMScoreAdjust").split()) == {"-900"}
    limits = (machine.root / f"proc/{program}/limits").read_text().splitlines()
    assert any(line.split() == ["Max", "realtime", "priority", "0", "0"] for line in limits), limits


def standing(machine: Machine, pid: int) -> list[str]:
    """What the kernel says of a process there."""
    return (machine.root / f"proc/{pid}/status").read_text().splitlines()


def group(machine: Machine) -> str:
    """The number of group failover."""
    return machine.run("getent", "group", "failover").stdout.split(":")[2]


def test_a_service_that_systemd_would_start_again_is_told_of(machine: Machine) -> None:
    command = ("python3", "-c", "import time; time.sleep(1000)")
    for unit, restart in (("again", "always"), ("once", "no")):
        machine.run("systemd-run", f"--unit={unit}", f"--property=Restart={restart}", *command)
        robots.until(lambda unit=unit: machine.property(f"{unit}.service", "MainPID") != "0", "the service to run")
        pid = machine.property(f"{unit}.service", "MainPID")
        checked = machine.run("failover", "check", pid, check=False)
        told = machine.run("failover", "protect", pid, "--name", unit)
        for said in (checked.stderr, told.stderr):
            assert (f"belongs to {unit}.service, which says Restart=always" in said) is (restart == "always")
        machine.run("failover", "release", unit)
        machine.run("systemctl", "stop", f"{unit}.service")


def test_a_job_of_a_service_that_systemd_would_start_again_is_not_told_of(machine: Machine) -> None:
    jobs = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'import time; time.sleep(1000)'])"
    machine.run("systemd-run", "--unit=jobs", "--property=Restart=always", "python3", "-c", jobs)

    def pids() -> list[str]:
        cgroup = machine.property("jobs.service", "ControlGroup")
        return machine.run("cat", f"/sys/fs/cgroup{cgroup}/cgroup.procs", check=False).stdout.split() if cgroup else []

    robots.until(lambda: len(pids()) == 2, "the job to run")
    main = machine.property("jobs.service", "MainPID")
    for pid in pids():
        checked = machine.run("failover", "check", pid, check=False)
        assert ("belongs to jobs.service, which says Restart=always" in checked.stderr) is (pid == main)
    machine.run("systemctl", "stop", "jobs.service")


def test_a_component_lives_outside_the_service(machine: Machine) -> None:
    pid = started(machine, "outside")
    cgroup = Path(f"/proc/{machine.outer(pid)}/cgroup").read_text()
    assert "failover.slice" in cgroup and SERVICE not in cgroup, cgroup


def test_components_outlive_a_restart_of_the_service(machine: Machine) -> None:
    pid = started(machine, "restarted")
    first = main_pid(machine)
    machine.run("systemctl", "restart", SERVICE)
    assert main_pid(machine) != first
    expect_it_to_count_on(machine, "restarted", pid)


def test_components_outlive_a_killed_service_and_systemd_starts_it_anew(machine: Machine) -> None:
    pid = started(machine, "killed")
    first = main_pid(machine)
    machine.run("systemctl", "kill", "--signal=SIGKILL", SERVICE)
    robots.until(lambda: main_pid(machine) not in (0, first), "systemd to start it anew")
    expect_it_to_count_on(machine, "killed", pid)


def test_a_main_loop_that_stands_still_is_found_by_the_watchdog(machine: Machine) -> None:
    pid = started(machine, "watched")
    first = main_pid(machine)
    os.kill(machine.outer(first), signal.SIGSTOP)
    robots.until(lambda: main_pid(machine) not in (0, first), "the watchdog to bite")
    expect_it_to_count_on(machine, "watched", pid)


def test_components_run_on_while_the_service_is_stopped(machine: Machine) -> None:
    pid = started(machine, "stopped")
    machine.run("systemctl", "stop", SERVICE)
    assert machine.property(SERVICE, "ActiveState") == "inactive"
    outer = machine.outer(pid)
    spent = cpu_ticks(outer)
    robots.until(lambda: cpu_ticks(outer) > spent, "the program to run on")
    machine.run("systemctl", "start", SERVICE)
    expect_it_to_count_on(machine, "stopped", pid)


def cpu_ticks(pid: int) -> int:
    """Processor time that a process has used, in ticks."""
    words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return int(words[11]) + int(words[12])


def test_the_program_ends_by_its_own_status_after_all_that(machine: Machine) -> None:
    with control(machine) as link:
        argv = ["/bin/sh", "-c", "sleep 1; exit 7"]
        link.ask("run", argv=argv, name="brief", env={"PATH": "/usr/bin:/bin"}, cwd="/", wait=False)
    machine.run("systemctl", "restart", SERVICE)
    deadline = time.monotonic() + robots.PATIENCE_S
    while component(machine, "brief").get("exit_status") is None and time.monotonic() < deadline:
        time.sleep(robots.POLL_S)
    ended = component(machine, "brief")
    assert ended.get("exit_status") is not None, (ended, machine.run("journalctl", "--unit", SERVICE, "--no-pager", "--lines=20"))
    assert os.waitstatus_to_exitcode(ended["exit_status"]) == 7


HOOKED = """
[components."/lab/robot1/hooked"]
hooks.before_start = ["/bin/sh", "-c", "grep CapEff /proc/self/status >/run/hooked; echo $FAILOVER_WHY >>/run/hooked"]
[components."/lab/robot1/unhooked"]
hooks.before_start = ["/bin/false"]
[components."/lab/robot1/stubborn"]
hooks.before_start = ["/bin/sh", "-c", "trap '' TERM; (while :; do sleep 1; done) & while :; do sleep 1; done"]
hooks.limit_s = 1
"""


def test_a_hook_is_not_shut_in_as_the_service_is_and_its_failure_is_told(machine: Machine) -> None:
    config = machine.root / "etc" / "failover" / "agent.toml"
    config.write_text(config.read_text() + HOOKED)
    machine.run("systemctl", "restart", SERVICE)
    robots.until(lambda: (machine.root / "run" / "failover" / "control.sock").exists(), "the agent to listen")
    started(machine, "hooked")
    capabilities, why = (machine.root / "run" / "hooked").read_text().splitlines()
    assert int(capabilities.split()[1], 16) and why == "started"
    started(machine, "unhooked")
    assert any("before_start (/bin/false) failed" in note for note in component(machine, "unhooked")["notes"])
    started(machine, "stubborn")
    assert machine.run("systemctl", "list-units", "failover-hook-*", "--no-legend", "--plain").stdout == "", "nothing outlives it"
    assert any("failed" in note for note in component(machine, "stubborn")["notes"])
    for name in ("hooked", "unhooked", "stubborn"):
        machine.run("failover", "stop", name)
