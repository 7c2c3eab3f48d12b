"""Several users on one robot: each program runs as the user who asked for it, and users give orders about their own alone.

On a booted machine with the service as it is shipped, and two real users who are members of its group.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator

import pytest

from tests.e2e import machines, robots, service
from tests.e2e.machines import Machine
from tests.e2e.service import SERVICE, component

pytestmark = [
    pytest.mark.root,
    pytest.mark.slow,
    pytest.mark.skipif(bool(machines.why_not()), reason=machines.why_not() or "-"),
]

STRANGER = 7003
"""No member of the group."""

PORTRAIT = """
import os, sys
print(os.getresuid(), os.getresgid(), sorted(os.getgroups()), oct(os.umask(0)), os.getcwd())
print(os.getpriority(os.PRIO_PROCESS, 0), os.sched_getscheduler(0), sorted(os.sched_getaffinity(0)))
print(open("/proc/self/limits").read(), open("/proc/self/oom_score_adj").read())
told = ("Cap", "NoNewPrivs", "Seccomp:", "SigBlk", "SigIgn", "Umask")
print(*(line for line in open("/proc/self/status") if line.startswith(told)))
print(sorted(os.environ.items()), sys.argv[1:])
"""
"""Everything that a program inherits, as it sees it itself."""

OURS = r"\('FAILOVER_EPOCH', '\d{20}'\), \('FAILOVER_TASK', '@failover\.[0-9a-f]{16}'\), "
"""What a portrait shows besides, of a program under an agent: the fencing token, and where its guard listens."""

ODD = "umask 027; ulimit -S -n 345; ulimit -l 99; ulimit -c 0; echo 321 >/proc/self/oom_score_adj; export COLOUR=green"
"""What a shell may have set up before it runs something."""

WRITER = """
import time
log = open("/var/alice/log", "a")
number = 0
while True:
    number += 1
    log.write(f"{number}\\n")
    log.flush()
    print(number, flush=True)
    time.sleep(0.01)
"""


ALERTS = """
[alerts]
user = "alice"
degraded_after_s = 1
on_degraded = ["/bin/sh", "-c", "cat >>/var/alice/alerts"]
"""


BOARD = """
[board]
group = "failover"
[board.items.map]
type = "u8"
user = "alice"
[board.items.ball]
type = "u8"
"""


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """A robot with two people on it."""
    with service.robot_with_users(tmp_path_factory.mktemp("machines"), alice=7001, bob=7002) as booted:
        for name, program in {"portrait": PORTRAIT, "writer": WRITER}.items():
            (booted.root / f"etc/{name}.py").write_text(program)
        booted.run("install", "-d", "-m755", "-oalice", "/var/alice")  # not sticky: there the kernel itself refuses to follow
        with (booted.root / "etc/failover/agent.toml").open("a") as settings:
            settings.write(ALERTS)
        with (booted.root / "etc/failover/team/team.toml").open("a") as members:
            members.write(BOARD)
        booted.run("systemctl", "start", SERVICE)
        yield booted


def as_user(machine: Machine, user: str, script: str) -> tuple[int, str]:
    """Have a user's shell run a script; its exit status, and all that was said."""
    return service.as_user(machine, user, "bash", "-c", script)


def test_an_operators_command_is_told_in_a_service_of_its_own_by_an_ordinary_users_rights(machine: Machine, alices: str) -> None:
    name, alerts = f"/lab/robot1/{alices}", machine.root / "var/alice/alerts"
    robots.until(lambda: alerts.exists() and name in alerts.read_text(), "the alert: this robot is alone in its team")
    assert alerts.stat().st_uid == 7001
    told = [json.loads(line) for line in alerts.read_text().splitlines()]
    (facts,) = (one for one in told if one["component"] == name)
    assert (facts["alert"], facts["robot"], facts["epoch"]) == ("degraded", "robot1", 1)
    assert facts["reason"].startswith("no other robot holds a checkpoint of it: ")


def test_the_journal_can_be_asked_for_one_component_with_its_epoch(machine: Machine, alices: str) -> None:
    name = f"/lab/robot1/{alices}"
    robots.until(lambda: "it runs at robot1" in of_the_journal(machine, f"COMPONENT={name}", "MESSAGE"), "its start to be told")
    assert "robot robot1 sends heartbeats, life 1" in of_the_journal(machine, "LOGGER=failover.heart", "MESSAGE").splitlines()
    assert set(of_the_journal(machine, f"COMPONENT={name}", "EPOCH").split()) == {"1"}
    assert "it runs at robot1" in of_the_journal(machine, "ROBOT=robot1", "MESSAGE")
    assert of_the_journal(machine, "COMPONENT=/lab/robot1/another", "MESSAGE") == ""


def of_the_journal(machine: Machine, *asked: str) -> str:
    """The values of a field (the last argument) in the entries of the agent that fit."""
    *fitting, field = asked
    entries = machine.run("journalctl", "--unit", SERVICE, "--output=cat", f"--output-fields={field}", *fitting, check=False)
    return str(entries.stdout)


@pytest.fixture(scope="module")
def alices(machine: Machine) -> str:
    """A component of Alice's that has checkpoints."""
    status, said = as_user(machine, "alice", "cd /; failover run --name alices --detach -- python3 -S /etc/writer.py")
    assert status == 0, said
    robots.until(lambda: int(component(machine, "alices").get("snapshots") or 0) >= 2, "snapshots")
    return "alices"


@pytest.mark.parametrize("user", ["alice", "root"])
def test_a_program_inherits_what_it_would_in_the_shell_of_whoever_asked(machine: Machine, user: str) -> None:
    """But for the signals that it ignores: those of whoever runs the tests are put back to their defaults."""
    portrait = "nice -n 5 taskset 1 env --default-signal python3 /etc/portrait.py 'of me'"
    _, expected = as_user(machine, user, f"cd /var; {ODD}; {portrait}")
    _, seen = as_user(machine, user, f"cd /var; {ODD}; {portrait.replace('python3', 'failover run -- python3')}")
    assert re.sub(OURS, "", seen, count=1) == expected
    assert "345" in seen and "'COLOUR', 'green'" in seen  # the script did set things up


def test_the_agent_gives_an_item_to_one_user_without_a_capability_and_another_members_put_is_refused(machine: Machine) -> None:
    assert as_user(machine, "alice", "failover board put map 7")[0] == 0
    status, said = as_user(machine, "bob", "failover board put map 8")
    assert (status, "user 'alice' (uid 7001) alone may put it, and this program runs as uid 7002" in said) == (1, True), said
    assert as_user(machine, "bob", "failover board put ball 8")[0] == 0
    status, said = as_user(machine, "bob", "failover board get map --json")
    assert (status, json.loads(said)["value"]) == (0, 7), said
    assert as_user(machine, "bob", ": <>/run/failover/board/own+7001")[0] != 0
    assert as_user(machine, "alice", ": <>/run/failover/board/own+7001")[0] == 0


def test_root_may_have_a_program_run_as_somebody_else(machine: Machine) -> None:
    _, expected = as_user(machine, "bob", "id")
    assert as_user(machine, "root", "failover run --user bob -- id") == (0, expected)


def test_nobody_else_may_choose_a_user(machine: Machine) -> None:
    status, said = as_user(machine, "bob", "failover run --user root -- id")
    assert status == 1 and "only root may choose a user" in said, said


def test_the_program_can_open_its_own_output(machine: Machine) -> None:
    assert as_user(machine, "bob", "failover run -- sh -c 'echo again >/dev/stdout'") == (0, "again\n")


@pytest.mark.parametrize(
    "order", ["logs {}", "stop {}", "release {}", "handover {}", "failback {}", "prefer {} robot1", "promote {} --yes"]
)
def test_orders_about_another_ones_component_are_refused(machine: Machine, alices: str, order: str) -> None:
    status, said = as_user(machine, "bob", f"failover {order.format(alices)}")
    assert status == 1 and "belongs to uid 7001" in said, said


def test_a_name_that_somebody_else_uses_is_refused(machine: Machine, alices: str) -> None:
    status, said = as_user(machine, "bob", f"failover run --name {alices} -- id")
    assert status == 1 and "belongs to uid 7001" in said, said


def test_everybody_of_the_group_sees_how_things_stand_and_whose_they_are(machine: Machine, alices: str) -> None:
    status, said = as_user(machine, "bob", "failover status --json")
    assert '"owner": 7001' in said, (status, said)


def test_a_stranger_cannot_ask_at_all(machine: Machine) -> None:
    status, said = as_user(machine, str(STRANGER), "failover status")
    assert status == 3 and "join the group" in said, said


def test_one_protects_ones_own_processes_alone(machine: Machine) -> None:
    status, said = as_user(machine, "bob", "sleep 1000 & failover protect $! --name bobs && failover release bobs; kill $!")
    assert status == 0, said
    status, said = as_user(machine, "bob", "failover protect 1 --name first")
    assert status == 1 and "not a process of uid 7002" in said, said


def rights(machine: Machine, name: str) -> list[str]:
    """Of a component's program, as the kernel shows them; empty while it has none."""
    try:
        lines = (machine.root / f"proc/{component(machine, name).get('pid')}/status").read_text().splitlines()
    except OSError:
        return []
    return [line for line in lines if line.startswith(("Uid", "Gid", "Groups", "Cap", "NoNew", "Seccomp:"))]


def test_a_program_comes_back_with_the_rights_that_it_had(machine: Machine, alices: str) -> None:
    before = rights(machine, alices)
    assert "Uid:\t7001\t7001\t7001\t7001" in before
    assert as_user(machine, "alice", f"kill -SEGV {component(machine, alices)['pid']}")[0] == 0
    robots.until(lambda: component(machine, alices).get("restores") == 1 and rights(machine, alices), "it to come back")
    assert rights(machine, alices) == before
    assert as_user(machine, "alice", f"failover logs {alices} | grep -c .")[0] == 0


def test_a_program_that_comes_back_opens_no_file_that_its_user_may_not(machine: Machine, alices: str) -> None:
    """Its log is replaced by a link to a file of root's, longer than the log was: as root it would be cut."""
    victim = machine.root / "etc/roots"
    victim.write_text("precious\n" * 100_000)
    pid = component(machine, alices)["pid"]
    as_user(machine, "alice", f"kill -STOP {pid}; rm /var/alice/log; ln -s /etc/roots /var/alice/log; kill -KILL {pid}")
    robots.until(lambda: any("cannot run it" in note for note in component(machine, alices)["notes"]), "it to be given up")
    assert victim.read_text() == "precious\n" * 100_000
    said = machine.run("journalctl", "--unit", SERVICE, "--no-pager").stdout
    assert "cannot open /var/alice/log: Permission denied" in said


def test_the_owner_gives_orders(machine: Machine, alices: str) -> None:
    status, said = as_user(machine, "alice", f"failover release {alices}")
    assert status == 0, said


REFUSED = """
exec 3< <(exec sleep 1000); writer=$!
sleep 1001 >/dev/null 2>&1 &
failover protect $! --name {}; status=$?; kill $! $writer; exit $status
"""
"""A process with a pipe from another one."""


def test_a_name_that_was_released_gives_its_next_user_nothing_of_what_its_last_user_wrote(machine: Machine) -> None:
    secret = "echo a secret of bob; exec sleep 1000"
    status, said = as_user(machine, "bob", f"failover run --name reused --detach -- sh -c '{secret}'")
    assert status == 0, said
    robots.until(lambda: "secret" in as_user(machine, "bob", "failover logs reused")[1], "its output")
    assert as_user(machine, "bob", "failover release reused")[0] == 0
    assert "secret" in as_user(machine, "bob", "failover logs reused")[1], "it is his, released or not"

    status, said = as_user(machine, "alice", REFUSED.format("reused"))
    assert status == 1, said
    status, said = as_user(machine, "alice", "failover logs reused")
    assert status == 1 and "belongs to uid 7002" in said and "secret" not in said, said
    assert "secret" in as_user(machine, "bob", "failover logs reused")[1], "a start that is refused takes nothing"

    status, said = as_user(machine, "alice", "sleep 1000 >/dev/null 2>&1 & failover protect $! --name reused")
    assert status == 0, said
    status, said = as_user(machine, "alice", "failover logs reused")
    assert status == 0 and "secret" not in said, said
    status, said = as_user(machine, "bob", "failover logs reused")
    assert status == 1 and "belongs to uid 7001" in said, said
    assert as_user(machine, "alice", "failover stop reused")[0] == 0


def test_a_start_that_is_refused_leaves_nothing_under_its_name(machine: Machine) -> None:
    for attempt in (
        REFUSED.format("nonexist"),
        "failover run --name nonexist -- /no/such/program",
        "failover run -- /no/such/nonexist",
    ):
        status, said = as_user(machine, "alice", attempt)
        assert status == 1, said
    assert "nonexist" not in as_user(machine, "alice", "failover status --json")[1]
    status, said = as_user(machine, "bob", "failover run --name nonexist -- id -u")
    assert (status, said) == (0, "7002\n"), "another user may have the name"
