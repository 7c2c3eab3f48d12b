"""The verbs as a person or a script uses them: the real command, a real socket, exit statuses, no traceback."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from failover.cli import key_pairs, parser
from failover.cli.verbs import team_invitations
from failover.client import control
from failover.client.control import Control, Output, Refused, Request, Result, Update
from failover.config import team
from failover.config.invitation import SECRET_SIZE, Invitation
from failover.errors import DriverError, NoAgentError
from tests.failover.cli.stand_in import Answer, StandIn

Start = Callable[[Callable[[Request], Answer]], StandIn]
COMMAND = [sys.executable, "-m", "failover.cli.main"]

COMPONENT = {
    "name": "/lab/robot1/mapper", "role": "primary", "primary": "robot1", "state": "running", "epoch": 3, "generation": 1,
    "sequence": 41, "engine": "ptrace", "pid": 77, "inner_pid": 2, "isolated": True, "standby": "robot2", "standby_sequence": 41,
    "lag_ms": 98.0, "period_ms": 100, "freeze_us": 912, "freeze_us_max": 1404, "snapshot_size": 40_000, "dirty_bytes": 90_000,
    "snapshots": 41, "restores": 0, "crashes": 0, "exit_status": None, "reasons": [], "notes": [],
}  # fmt: skip
PEER = {
    "name": "robot2", "role": "witness", "state": "live", "last_heard_ms": 12, "beats_lost": 0, "lane": "connected", "notes": [],
}  # fmt: skip
STATUS = {
    "robot": "robot1", "team": "lab", "role": "robot", "pid": 4, "version": "0.1.0", "insecure": False,
    "realtime": True, "promise": "If robot1 dies now, robot2 goes on.", "notes": [], "peers": [PEER], "components": [COMPONENT],
}  # fmt: skip


@pytest.fixture
def agent(tmp_path: Path) -> Iterator[Start]:
    """Start stand-ins for an agent; they are closed afterwards."""
    running: list[StandIn] = []

    def start(answer: Callable[[Request], Answer]) -> StandIn:
        running.append(StandIn(tmp_path / "control.sock", answer))
        return running[-1]

    yield start
    for one in running:
        one.close()


def failover(*words: str, socket: Path | None = None, **kwargs: Any) -> subprocess.CompletedProcess[str]:
    """Run the command."""
    environment = os.environ | {"FAILOVER_SOCKET": str(socket or "/nonexistent/control.sock")}
    kwargs.setdefault("stdin", subprocess.DEVNULL)
    ran = subprocess.run([*COMMAND, *words], capture_output=True, text=True, env=environment, timeout=60, check=False, **kwargs)
    assert "Traceback" not in ran.stderr + ran.stdout
    return ran


def answering(value: dict[str, Any]) -> Callable[[Request], Answer]:
    """An agent that always says the same."""
    return lambda request: [Result(value)]


# --- Status ----------------------------------------------------------------------------------------------------------


def test_status_of_one_component_tells_all_that_is_known_and_ends_as_that_one_is(agent: Start) -> None:
    camera = COMPONENT | {"name": "/lab/robot1/camera", "state": "failed", "notes": ["it could not be resumed: no camera"]}
    namesake = COMPONENT | {"name": "/lab/robot2/camera"}
    socket = agent(answering(STATUS | {"components": [COMPONENT, camera, namesake]})).path
    well, unwell = failover("status", "mapper", socket=socket), failover("status", "robot1/camera", socket=socket)
    assert (well.returncode, unwell.returncode) == (0, 1)
    assert "/lab/robot1/mapper" in well.stdout and "98 ms old" in well.stdout and "0.91 ms, at most 1.40 ms" in well.stdout
    assert "camera" not in well.stdout and "no camera" in unwell.stdout
    nothing, both = failover("status", "nothing", socket=socket), failover("status", "camera", socket=socket)
    assert nothing.returncode == both.returncode == 1
    assert "no component is called 'nothing'; this team protects /lab/robot1/camera, /lab/robot1/mapper and" in nothing.stderr
    assert "'camera' could be /lab/robot1/camera and /lab/robot2/camera; give the whole name" in both.stderr


def test_status_in_brief_is_one_line_while_all_is_well(agent: Start) -> None:
    well = failover("status", "--brief", socket=agent(answering(STATUS)).path)
    assert (well.returncode, well.stdout) == (0, "healthy: 2 of 2 members live, 1 of 1 components well\n")


def test_status_in_brief_names_what_is_not_well(agent: Start) -> None:
    silent = PEER | {"state": "dead", "last_heard_ms": 14_000}
    alone = COMPONENT | {"standby": "", "notes": ["no robot stands by: robot2 is silent"]}
    unwell = failover("status", "--brief", socket=agent(answering(STATUS | {"peers": [silent], "components": [alone]})).path)
    assert (unwell.returncode, unwell.stdout.splitlines()) == (
        1,
        [
            "DEGRADED: 1 of 2 members live, 0 of 1 components well",
            "/lab/robot1/mapper: running; no robot stands by: robot2 is silent",
            "robot2: dead, heard 14 s ago",
        ],
    )


def test_status_shows_the_team_as_a_tree_and_is_healthy(agent: Start) -> None:
    ran = failover("status", socket=agent(answering(STATUS)).path)
    assert ran.returncode == 0, ran.stderr
    lines = ran.stdout.splitlines()
    assert lines[0].split() == ["role", "state", "engine", "epoch", "lag", "freeze", "standby", "links"]
    assert lines[1].startswith("robot1 (here)")
    assert " ".join(lines[2].split()) == "└─ /lab/robot1/mapper primary running ptrace 3 98 ms 0.91 ms (max 1.40) robot2"
    assert lines[3].split()[:3] == ["robot2", "witness", "live"]
    assert "promise: If robot1 dies now, robot2 goes on." in lines


@pytest.mark.parametrize(
    "change",
    [
        {"components": [COMPONENT | {"state": "degraded", "reasons": ["fd 7 is a socket"]}]},
        {"components": [COMPONENT | {"state": "failed"}]},
        {"components": [COMPONENT | {"standby": None}]},
        {"peers": [PEER | {"state": "dead"}]},
    ],
)
def test_status_says_by_its_exit_status_that_something_is_degraded(agent: Start, change: dict[str, Any]) -> None:
    ran = failover("status", socket=agent(answering(STATUS | change)).path)
    assert ran.returncode == 1
    for component in change.get("components", []):
        for reason in component["reasons"]:
            assert reason in ran.stdout


def test_a_program_that_has_stopped_committing_is_told_apart_in_words(agent: Start) -> None:
    told = {"engine": "cooperative", "freeze_us": 0, "lag_ms": 14_300.0, "commit_age_ms": 14_210.0, "commit_overdue": True}
    ran = failover("status", socket=agent(answering(STATUS | {"components": [COMPONENT | told]})).path)
    assert ran.returncode == 0, "it runs, and its standby has what it committed"
    row = " ".join(ran.stdout.splitlines()[2].split())
    assert row == "└─ /lab/robot1/mapper primary running, last commit 14 s ago cooperative 3 14.3 s never robot2"


def test_a_component_for_which_something_else_holds_has_a_promise_of_its_own(agent: Start) -> None:
    told = {"promise": "If robot1 is lost, robot2 keeps it.", "promise_differs": True}
    usual = COMPONENT | {"name": "/lab/robot1/other", "promise": "as ever", "promise_differs": False}
    ran = failover("status", socket=agent(answering(STATUS | {"components": [COMPONENT | told, usual]})).path)
    lines = [line for line in ran.stdout.splitlines() if line.startswith("promise")]
    assert lines == [
        "promise: If robot1 dies now, robot2 goes on.",
        "promise for /lab/robot1/mapper: If robot1 is lost, robot2 keeps it.",
    ]


def test_a_server_shows_what_it_keeps_for_whom_how_much_and_how_old(agent: Start) -> None:
    found = {"checkpoints": 8, "older": 3, "size": 1_200_000, "newest_age_s": 0.2, "oldest_age_s": 18_000.0}
    told = STATUS | {"role": "server", "components": [COMPONENT | {"role": "standby", "kept": found}]}
    ran = failover("status", socket=agent(answering(told)).path)
    assert "kept for robot1: /lab/robot1/mapper, 8 checkpoints and 3 older, 1.2 MB, 200 ms to 5 h old" in ran.stdout.splitlines()


def test_a_server_that_cannot_store_what_comes_is_not_healthy(agent: Start) -> None:
    told = STATUS | {"components": [COMPONENT | {"unstored": "No space left on device", "notes": ["a snapshot was not stored"]}]}
    ran = failover("status", socket=agent(answering(told)).path)
    assert ran.returncode == 1 and "a snapshot was not stored" in ran.stdout


def test_an_ended_component_needs_no_standby(agent: Start) -> None:
    ended = COMPONENT | {"state": "ended", "standby": None, "exit_status": 0x300}
    ran = failover("status", socket=agent(answering(STATUS | {"components": [ended]})).path)
    assert ran.returncode == 0
    assert "ended (exit 3)" in ran.stdout


WAITS = (
    {"protection": "none", "arriving": [{"to": "robot2", "what": "files", "arrived": 1_000_000, "size": 4_000_000}]},
    {"protection": "none", "arriving": [{"to": "robot2", "what": "checkpoint", "arrived": 1_500_000_000, "size": 2_000_000_000}]},
)


def waiting(*pictures: dict[str, Any], every: int = 8) -> Callable[[Request], Answer]:
    """An agent that protects a program, and shows each of these some times in turn, the last one for good."""
    asked = 0

    def answer(request: Request) -> Answer:
        nonlocal asked
        if request.verb != "status":
            return [Result({"name": COMPONENT["name"], "pid": 41, "notes": []})]
        asked += 1
        shown = pictures[min(asked // every, len(pictures) - 1)]
        return [Result(STATUS | {"peers": [PEER | {"role": "robot"}], "components": [COMPONENT | shown]})]

    return answer


def test_a_copy_in_the_archive_alone_is_not_said_to_be_at_a_robot_that_stands_by(agent: Start) -> None:
    ran = failover("run", "--wait", "--detach", "--", "x", socket=agent(waiting({"protection": "protected", "standby": ""})).path)
    assert ran.returncode == 0
    assert "a copy of it is in the archive" in ran.stderr and "it is protected" not in ran.stderr


@pytest.mark.parametrize("words", [("protect", "41"), ("run", "--detach", "--", "x")])
def test_waiting_for_the_first_checkpoint_tells_how_much_of_what_has_arrived(agent: Start, words: tuple[str, ...]) -> None:
    socket = agent(waiting(*WAITS, {"protection": "protected"})).path
    ran = failover(words[0], "--wait", *words[1:], socket=socket)
    assert ran.returncode == 0 and str(COMPONENT["name"]) in ran.stdout
    line, *told = ran.stderr.splitlines()  # a plain one each five seconds
    assert told == ([f"{COMPONENT['standby']} holds a checkpoint of it: it is protected"] if words[0] == "run" else [])
    assert line.startswith("/lab/robot1/mapper: ") and (
        "(75 %)" in line or "program files to robot2: 1.0 MB of 4.0 MB (25 %)" in line
    )
    assert failover(words[0], "--wait", "--json", *words[1:], socket=socket).stderr == ""


def test_a_program_whose_output_is_shown_is_not_waited_for(agent: Start) -> None:
    stand_in = agent(waiting({"protection": "protected"}))
    ran = failover("run", "--wait", "--", "x", socket=stand_in.path)
    assert ran.returncode == 1 and "--wait goes with --detach" in ran.stderr and not stand_in.asked


@pytest.mark.parametrize(
    ("shown", "told"),
    [
        ({"components": []}, "is not seen: it was released, or you may not see it"),
        ({"components": [COMPONENT | {"state": "failed", "protection": "none"}]}, "is failed: it will not be protected"),
        ({"peers": [], "components": [COMPONENT | {"protection": "none"}]}, "no other member of the team keeps checkpoints"),
    ],
)
def test_a_wait_for_what_will_not_come_ends(agent: Start, shown: dict[str, Any], told: str) -> None:
    def answer(request: Request) -> Answer:
        return [Result(STATUS | shown if request.verb == "status" else {"name": COMPONENT["name"], "pid": 41, "notes": []})]

    ran = failover("protect", "--wait", "41", socket=agent(answer).path)
    assert ran.returncode == 1 and told in ran.stderr


def test_status_as_json_is_the_agents_own_answer(agent: Start) -> None:
    ran = failover("status", "--json", socket=agent(answering(STATUS)).path)
    assert json.loads(ran.stdout) == STATUS


def test_watching_shows_every_picture_until_interrupted(agent: Start) -> None:
    more = threading.Event()

    def pictures(request: Request) -> Iterator[Update]:
        yield Update(STATUS)
        yield Update(STATUS)
        more.wait()

    stand_in = agent(pictures)
    environment = os.environ | {"FAILOVER_SOCKET": str(stand_in.path)}
    with subprocess.Popen([*COMMAND, "status", "--watch", "--json"], env=environment, stdout=subprocess.PIPE, text=True) as ran:
        assert ran.stdout is not None
        assert [json.loads(ran.stdout.readline())["robot"] for _ in range(2)] == ["robot1", "robot1"]
        ran.send_signal(signal.SIGINT)
        assert ran.wait() == 0
    more.set()
    assert stand_in.asked[0].arguments["watch"] is True


CHECKED = {
    "refused": (
        {"realtime": False, "notes": ["beats run at normal priority: the system refused SCHED_FIFO (not permitted); give it"]},
        ("lesser", "the agent says: beats run at normal priority: the system refused SCHED_FIFO"),
    ),
    "not asked for": ({"realtime": False}, ("lesser", "agent.toml says realtime = false")),
    "had": ({}, ("good", "the agent's main loop has it, and its memory is locked")),
}


@pytest.mark.parametrize(("answer", "said"), CHECKED.values(), ids=CHECKED)
def test_check_says_what_the_agent_was_given_and_not_what_this_shell_may_have(
    agent: Start, answer: dict[str, Any], said: tuple[str, str]
) -> None:
    ran = failover("check", "--json", socket=agent(answering(STATUS | {"components": []} | answer)).path)
    found = [offer for offer in json.loads(ran.stdout)["offers"] if offer["what"] in ("real-time priority", "locked memory")]
    assert [offer["verdict"] for offer in found] == [said[0]] and said[1] in found[0]["text"]


# --- Run -------------------------------------------------------------------------------------------------------------


def started(name: str = "/demo/x") -> Update:
    """What an agent says first about a program that it has started."""
    return Update({"started": {"name": name, "pid": 5, "inner_pid": 2, "isolated": True, "notes": []}})


@pytest.mark.parametrize(("wait_status", "status"), [(0, 0), (7 << 8, 7), (9, 137)])
def test_output_and_exit_status_of_run_are_the_programs_own(agent: Start, wait_status: int, status: int) -> None:
    stand_in = agent(
        lambda request: [
            started(),
            Output(1, 0, b"one\n"),
            Output(2, 0, b"two\n"),
            Result({"name": "x", "exit_status": wait_status}),
        ]
    )
    ran = failover("run", "--name", "/demo/x", "--", "prog", "--flag", socket=stand_in.path)
    assert (ran.returncode, ran.stdout, ran.stderr) == (status, "one\n", "two\n")
    asked = stand_in.asked[0].arguments
    assert asked["argv"] == ["prog", "--flag"]
    assert asked["name"] == "/demo/x"
    assert asked["cwd"] == os.getcwd()


def test_run_goes_on_where_it_stopped_when_the_agent_was_restarted(agent: Start) -> None:
    def answer(request: Request) -> Answer:
        if request.verb == "run":
            return [started(), Output(1, 0, b"before ")]
        assert request.verb == "logs"
        assert request.arguments["offsets"] == [7, 0]
        return [Output(1, 7, b"after"), Result({"name": "/demo/x", "totals": [12, 0], "exit_status": 0})]

    ran = failover("run", "--", "prog", socket=agent(answer).path)
    assert (ran.returncode, ran.stdout) == (0, "before after")


def test_ctrl_c_is_passed_on_to_the_program(agent: Start) -> None:
    ended = threading.Event()

    def answer(request: Request) -> Iterator[Update | Output | Result]:
        if request.verb == "stop":
            ended.set()
            yield Result({"name": "/demo/x", "exit_status": int(request.arguments["signal"])})
        else:
            yield started()
            yield Output(1, 0, b"ready\n")
            ended.wait()
            yield Result({"name": "/demo/x", "exit_status": 2})

    stand_in = agent(answer)
    environment = os.environ | {"FAILOVER_SOCKET": str(stand_in.path)}
    with subprocess.Popen([*COMMAND, "run", "--", "prog"], env=environment, stdout=subprocess.PIPE, text=True) as ran:
        assert ran.stdout is not None
        assert ran.stdout.readline() == "ready\n"
        ran.send_signal(signal.SIGINT)
        assert ran.wait() == 130
    assert [(request.verb, request.arguments.get("signal")) for request in stand_in.asked[1:]] == [("stop", 2)]


def test_a_detached_run_prints_the_name(agent: Start) -> None:
    ran = failover("run", "--detach", "--", "prog", socket=agent(answering({"name": "/x", "pid": 1, "notes": []})).path)
    assert (ran.returncode, ran.stdout) == (0, "/x\n")


# --- The others ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "answer", "sentence"),
    [
        (["protect", "41", "--name", "/a"], {"name": "/a", "pid": 41, "notes": []}, "pid 41 is protected as /a"),
        (["release", "/a"], {"name": "/a", "pid": 41}, "/a runs on as pid 41, unprotected"),
        (["stop", "/a"], {"name": "/a", "exit_status": 15}, "/a has ended: signal 15"),
        (
            ["handover", "/a"],
            {"name": "/a", "to": "r2", "epoch": 4, "took_ms": 12},
            "/a runs on r2 now; the move took 12 ms",
        ),
        (["prefer", "/a", "r1"], {"name": "/a", "robot": "r1"}, "/a prefers r1"),
    ],
)
def test_a_verb_says_in_a_sentence_what_came_of_it(agent: Start, words: list[str], answer: dict[str, Any], sentence: str) -> None:
    stand_in = agent(answering(answer))
    ran = failover(*words, socket=stand_in.path)
    assert (ran.returncode, ran.stdout.strip()) == (0, sentence)
    assert stand_in.asked[0].verb == words[0]
    assert json.loads(failover(*words, "--json", socket=stand_in.path).stdout) == answer


def component_at(robot: str, **more: Any) -> dict[str, Any]:
    return {"name": "/a", "primary": robot, "role": "standby", "state": "running", "epoch": 1, "notes": [], **more}


def draining(agent: Start, *pictures: list[dict[str, Any]]) -> StandIn:
    """An agent that drains a robot, and then sees the team like this, one picture a question, the last one for good."""
    left = list(pictures)

    def answer(request: Request) -> Any:
        if request.verb == "drain":
            return answering({"robot": "r1", "drained": True, "sentence": "r1 is drained"})(request)
        return answering({"components": left.pop(0) if len(left) > 1 else left[0]})(request)

    return agent(answer)


def test_a_drain_waits_until_each_component_runs_elsewhere(agent: Start) -> None:
    stand_in = draining(agent, [component_at("r1")], [component_at("r1")], [component_at("r2")])
    ran = failover("drain", "r1", socket=stand_in.path)
    assert (ran.returncode, ran.stdout) == (0, "/a runs at r2\nr1 is drained\n")
    assert stand_in.asked[0].arguments == {"robot": "r1"}


def test_a_drain_says_what_cannot_move_and_why(agent: Start) -> None:
    stays = component_at("r1", notes=["r1 is drained, and it stays: no other robot that is heard keeps its checkpoints"])
    path = draining(agent, [stays]).path
    ran = failover("drain", "r1", "--timeout", "0.3", socket=path)
    assert ran.returncode == 1
    assert "r1 is drained, and still runs /a: r1 is drained, and it stays: no other robot that is heard" in ran.stderr
    shown = failover("drain", "r1", "--timeout", "0.3", "--json", socket=path)
    assert shown.returncode == 1 and list(json.loads(shown.stdout)["left"]) == ["/a"]


WOULD = {"name": "/a", "to": "r2", "epoch": 4, "promoted": False, "sentence": "/a would resume at r2", "risks": ["r1 may live"]}


def promoting(agent: Start, would: dict[str, Any]) -> StandIn:
    """An agent that tells what a promotion would risk, and obeys whoever is sure."""
    done = {"name": "/a", "to": "r2", "epoch": 6, "promoted": True, "sentence": "/a runs at r2", "risks": []}
    return agent(lambda request: [Result(done if request.arguments.get("sure") else would)])


def test_what_a_promotion_risks_is_told_and_without_a_yes_nothing_is_done(agent: Start) -> None:
    stand_in = promoting(agent, WOULD)
    ran = failover("promote", "/a", socket=stand_in.path)
    assert ran.returncode == 1 and "/a would resume at r2\n  - r1 may live\n" in ran.stderr and "--yes" in ran.stderr
    assert json.loads(failover("promote", "/a", "--json", socket=stand_in.path).stdout)["reasons"] == ["r1 may live"]
    assert not any(request.arguments.get("sure") for request in stand_in.asked)


def test_a_promotion_is_ordered_at_the_robot_whose_risks_were_told(agent: Start) -> None:
    stand_in = promoting(agent, WOULD)
    ran = failover("promote", "/a", "--yes", socket=stand_in.path)
    assert (ran.returncode, ran.stdout) == (0, "/a runs on r2 now, epoch 6\n") and "r1 may live" in ran.stderr
    assert stand_in.asked[-1].arguments == {"name": "/a", "robot": "r2", "sure": True}


def test_a_promotion_without_risk_needs_no_yes(agent: Start) -> None:
    ran = failover("promote", "/a", socket=promoting(agent, WOULD | {"risks": []}).path)
    assert (ran.returncode, ran.stdout) == (0, "/a runs on r2 now, epoch 6\n")


@pytest.mark.parametrize(("said", "returncode"), [(b"y\n", 0), (b"\n", 1)])
def test_a_person_at_a_terminal_is_asked_before_a_promotion(agent: Start, said: bytes, returncode: int) -> None:
    ours, theirs = os.openpty()
    try:
        os.write(ours, said)
        ran = failover("promote", "/a", socket=promoting(agent, WOULD).path, stdin=theirs)
    finally:
        os.close(ours)
        os.close(theirs)
    assert ran.returncode == returncode and "promote r2 all the same? [y/N]" in ran.stderr


def test_followed_logs_show_nothing_older_after_the_agent_was_restarted(agent: Start) -> None:
    seen: list[dict[str, Any]] = []

    def answer(request: Request) -> Answer:
        seen.append(request.arguments)
        if len(seen) == 1:
            return [Output(1, 900, b"new")]
        return [Result({"name": "x", "totals": [903, 500], "exit_status": 0})]

    assert failover("logs", "x", "--follow", "--since", "1min", socket=agent(answer).path).stdout == "new"
    first, second = seen
    assert first["since_ms"] == 60_000 and second["offsets"] == [903, 0]
    assert 60_000 <= second["since_ms"] < 120_000, "of standard error, of which nothing was shown, nothing older either"


def test_logs_can_show_one_stream_alone(agent: Start) -> None:
    stand_in = agent(
        lambda request: [Output(1, 0, b"a"), Output(2, 0, b"b"), Result({"name": "x", "totals": [1, 1], "exit_status": 0})]
    )
    assert failover("logs", "x", socket=stand_in.path).stdout == "a"
    assert failover("logs", "x", "--stream", "2", socket=stand_in.path).stderr == "b"


def test_a_refusal_is_a_sentence_with_its_reasons_and_exit_status_1(agent: Start) -> None:
    stand_in = agent(lambda request: [Refused("UnsupportedError", "cannot protect pid 41", ("fd 3 is a socket; close it",))])
    ran = failover("protect", "41", socket=stand_in.path)
    assert ran.returncode == 1
    assert ran.stderr.splitlines() == ["failover: cannot protect pid 41", "  - fd 3 is a socket; close it"]
    as_json = json.loads(failover("protect", "41", "--json", socket=stand_in.path).stdout)
    assert as_json == {"error": "UnsupportedError", "message": "cannot protect pid 41", "reasons": ["fd 3 is a socket; close it"]}


def test_an_agent_that_goes_away_is_an_error_and_not_a_hang(agent: Start) -> None:
    ran = failover("status", socket=agent(lambda request: []).path)
    assert ran.returncode == 1
    assert "ended during status" in ran.stderr


AGENT_VERBS = [
    ["run", "--", "x"], ["protect", "1"], ["release", "x"], ["stop", "x"], ["status"], ["logs", "x"], ["why"], ["handover", "x"],
    ["prefer", "x", "r"], ["promote", "x"], ["drain", "r"], ["undrain", "r"],
]  # fmt: skip


@pytest.mark.parametrize("words", AGENT_VERBS, ids=lambda words: words[0])
def test_without_an_agent_the_exit_status_is_3_and_the_cure_is_named(words: list[str]) -> None:
    ran = failover(*words)
    assert ran.returncode == 3
    assert "start failover-agent" in ran.stderr


@pytest.mark.parametrize(
    "words", [[], ["fly"], ["protect", "-3"], ["protect", "x"], ["stop", "x", "--signal", "FOO"], ["capture", "1"]]
)
def test_a_mistake_in_the_command_line_is_exit_status_2(words: list[str]) -> None:
    assert failover(*words).returncode == 2


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("stauts", "did you mean 'status'?"),
        ("run --engine ptrce -- x", "'ptrce' is none of auto, ptrace, cooperative; did you mean 'ptrace'?"),
        ("run --output=comitted -- x", "'comitted' is none of immediate, committed; did you mean 'committed'?"),
        ("run --portable=x86-64-v9 -- x", "is none of no, x86-64-v1"),
        (
            "run --device /dev/x=repen -- x",
            "'repen'; say reopen, hook, optional, or the path of a device; did you mean 'reopen'?",
        ),
        ("protect 1 --connections cary", "'cary' is none of reset, carry, refuse; did you mean 'carry'?"),
        ("stop x --signal TREM", "did you mean 'TERM'?"),
        ("team shwo", "'shwo' is none of create, invite, join, list, remove, rotate, enrol, show; did you mean 'show'?"),
        ("team enrol x 192.0.2.1 --role servr", "'servr' is none of robot, server, witness; did you mean 'server'?"),
        ("completion zhs", "'zhs' is none of bash, zsh, tcsh; did you mean 'zsh'?"),
        ("logs x --stream 3", "3 is none of 1, 2"),
    ],
)
def test_a_word_that_is_none_of_its_choices_is_answered_with_all_of_them(words: str, said: str) -> None:
    ran = failover(*words.split())
    assert (ran.returncode, said in ran.stderr) == (2, True), ran.stderr


@pytest.mark.parametrize("verb", [verb.name for verb in parser.VERBS])
def test_every_verb_explains_itself(verb: str) -> None:
    ran = failover(verb, "--help")
    assert ran.returncode == 0
    assert f"  failover {verb}" in ran.stdout, "no example"
    assert "Exit status" in ran.stdout


@pytest.mark.parametrize("shell", ["bash", "zsh", "tcsh"])
def test_completion_knows_every_verb(shell: str) -> None:
    script = failover("completion", shell).stdout
    assert all(verb.name in script for verb in parser.VERBS)


@pytest.mark.command("bash")
@pytest.mark.parametrize(
    ("typed", "offered"),
    [("st", {"start", "stop", "status"}), ("team en", {"enrol"}), ("run --na", {"--name"}), ("completion z", {"zsh"})],
)
def test_a_real_bash_completes(typed: str, offered: set[str], tmp_path: Path) -> None:
    (tmp_path / "failover.bash").write_text(failover("completion", "bash").stdout)
    *before, last = ["failover", *typed.split()]
    script = f"""
        source {tmp_path}/failover.bash
        function=$(complete -p failover | sed 's/.*-F \\([^ ]*\\).*/\\1/')
        COMP_WORDS=({" ".join([*before, last])}) COMP_CWORD={len(before)}
        $function failover '{last}' '{before[-1]}'
        printf '%s\\n' "${{COMPREPLY[@]}}"
    """
    ran = subprocess.run(["bash", "--norc", "-c", script], capture_output=True, text=True, check=False)
    assert set(ran.stdout.split()) == offered, ran.stderr


def test_a_reader_that_has_seen_enough_is_no_error_message(agent: Start) -> None:
    stand_in = agent(lambda request: [*(Output(1, n * 1000, b"x" * 999 + b"\n") for n in range(2000)), Result({"name": "x"})])
    command = f"{' '.join(COMMAND)} logs x | head -n 1"
    environment = os.environ | {"FAILOVER_SOCKET": str(stand_in.path)}
    ran = subprocess.run(["sh", "-c", command], env=environment, capture_output=True, text=True, check=False)
    assert ran.stderr == ""


# --- Team ------------------------------------------------------------------------------------------------------------

KEY = "a" * 40


def test_a_team_is_created_enrolled_into_and_shown(tmp_path: Path) -> None:
    place = ["--directory", str(tmp_path)]
    assert failover("team", "create", "lab", "--empty", *place).returncode == 0
    assert failover("team", "enrol", "robot1", "10.0.0.1", "10.1.0.1:9", "--public-key", KEY, *place).returncode == 0
    ran = failover("team", "enrol", "robot2", "fe80::1", "--public-key", KEY, *place)
    assert ran.returncode == 1 and "robot2 and robot1 have the same public key" in ran.stderr
    assert failover("team", "enrol", "robot2", "fe80::1", "--public-key", "b" * 40, *place).returncode == 0
    shown = json.loads(failover("team", "show", "--json", *place).stdout)
    assert shown["team"] == "lab"
    assert shown["robots"]["robot1"] == {
        "role": "robot", "beats": ["10.0.0.1:7420", "10.1.0.1:9"], "bulk": "10.0.0.1:7421", "public_key": KEY,
    }  # fmt: skip
    assert shown["robots"]["robot2"]["beats"] == ["[fe80::1]:7420"]


def test_servers_and_witnesses_are_enrolled_and_stay_what_they_are(tmp_path: Path) -> None:
    place = ["--directory", str(tmp_path), "--json"]
    failover("team", "create", "lab", "--empty", *place)
    ran = failover("team", "enrol", "hall", "10.0.0.1", "--role", "server", "--public-key", KEY, *place)
    assert json.loads(ran.stdout)["role"] == "server"
    assert failover("team", "enrol", "gate", "10.0.0.2", "--role", "witness", *place).returncode == 0
    assert failover("team", "enrol", "gate", "10.0.0.9", "--replace", *place).returncode == 0
    shown = json.loads(failover("team", "show", *place).stdout)["robots"]
    assert {name: one["role"] for name, one in shown.items()} == {"hall": "server", "gate": "witness"}


def test_a_member_with_a_fresh_key_stays_at_its_site(tmp_path: Path) -> None:
    place = ["--directory", str(tmp_path)]
    failover("team", "create", "lab", "--empty", *place)
    for words in (["10.0.0.1", "--site", "harbour"], ["10.0.0.9", "--replace"]):
        assert failover("team", "enrol", "r9", *words, *place).returncode == 0
        assert team.read(tmp_path).robots["r9"].site == "harbour"
    assert failover("team", "enrol", "r9", "10.0.0.9", "--replace", "--site", "", *place).returncode == 0
    assert not team.read(tmp_path).robots["r9"].site


def enrolled(place: Path, name: str, address: str) -> str:
    """What is said to somebody who enrols a robot, with a key that is made here."""
    ran = failover("team", "enrol", name, address, "--directory", str(place))
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def test_a_robot_that_is_enrolled_on_itself_is_told_to_keep_its_key(tmp_path: Path) -> None:
    place = tmp_path / "team"
    failover("team", "create", "lab", "--empty", "--directory", str(place))
    alone = tmp_path / "alone"
    failover("team", "create", "lab", "--empty", "--directory", str(alone))
    (tmp_path / "agent.toml").write_text('robot = "r1"\n')
    by_name, by_address = enrolled(place, "r1", "192.0.2.11"), enrolled(alone, "r2", "127.0.0.1:7420")
    for said, key in ((by_name, place / "keys" / "r1.secret"), (by_address, alone / "keys" / "r2.secret")):
        assert "its secret key stays here" in said and str(key) in said and "remove" not in said
    for name, address in (("r3", "192.0.2.13"), ("r4", "robot4.example")):
        said = enrolled(place, name, address)
        assert f"if this machine is not {name}, copy {place / 'keys' / name}.secret to {name} alone, then remove it here" in said


def test_nothing_advises_to_delete_a_key_that_is_there(tmp_path: Path) -> None:
    place = ["--directory", str(tmp_path)]
    failover("team", "create", "lab", "--empty", *place)
    enrolled(tmp_path, "r1", "127.0.0.1")
    (tmp_path / "team.toml").unlink()
    failover("team", "create", "lab", "--empty", *place)
    ran = failover("team", "enrol", "r1", "127.0.0.1", *place)
    assert ran.returncode == 1 and "r1.secret exists" in ran.stderr and "emove it" not in ran.stderr


def test_an_invitation_at_an_address_that_this_robot_has_not_says_so(tmp_path: Path) -> None:
    place = ["--directory", str(tmp_path / "team")]
    begun = failover("team", "create", "lab", "--robot", "robot1", "--address", "127.0.0.1", "--no-start", *place)
    assert begun.returncode == 0 and "then: failover team invite ROBOT" in begun.stdout
    ran = failover("team", "invite", "robot2", "--address", "203.0.113.9", *place)
    assert ran.returncode == 1 and "no interface has 203.0.113.9 now: see ip address; --address names another one" in ran.stderr
    with contextlib.closing(socket.create_server(("127.0.0.1", 0))) as taken:
        port = str(taken.getsockname()[1])
        ran = failover("team", "invite", "robot2", "--port", port, *place)
    assert ran.returncode == 1 and f"another invitation is open, or another program uses port {port}: --port" in ran.stderr


@pytest.mark.parametrize(
    ("number", "cure"),
    [
        (errno.EADDRINUSE, "another invitation is open, or another program uses port 80"),
        (errno.EADDRNOTAVAIL, "no interface has 127.0.0.1 now"),
        (errno.EACCES, "only root may listen at port 80: --port names one from 1024 on"),
        (errno.EMFILE, "--address names another address of this robot, --port another port"),
    ],
)
def test_an_invitation_that_cannot_be_open_says_what_helps(number: int, cure: str) -> None:
    error = DriverError("cannot listen")
    error.__cause__ = OSError(number, os.strerror(number))
    assert cure in team_invitations._cure(Invitation("robot2", "127.0.0.1", 80, bytes(SECRET_SIZE), "robot"), error)


def test_before_there_is_a_team_its_begin_is_told_in_place_of_a_socket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "SYSTEM_SOCKET", tmp_path / "control.sock")
    monkeypatch.setattr(control, "SYSTEM_TEAM", tmp_path / "team.toml")
    monkeypatch.setattr(control, "SYSTEM_CONFIG", tmp_path / "agent.toml")
    with pytest.raises(NoAgentError, match="this machine has no team yet: failover team create NAME begins one"):
        Control.open(tmp_path / "control.sock")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (tmp_path / "agent.toml").write_text(f'team_directory = "{elsewhere}"\n')
    with pytest.raises(NoAgentError, match="this machine has no team yet"):
        Control.open(tmp_path / "control.sock")
    (elsewhere / "team.toml").touch()
    with pytest.raises(NoAgentError, match="no agent has been started there; start failover-agent"):
        Control.open(tmp_path / "control.sock")
    (tmp_path / "agent.toml").unlink()
    (tmp_path / "team.toml").touch()
    with pytest.raises(NoAgentError, match="no agent has been started there; start failover-agent"):
        Control.open(tmp_path / "control.sock")


def test_without_a_team_file_the_way_to_one_is_named(tmp_path: Path) -> None:
    ran = failover("team", "show", "--directory", str(tmp_path))
    assert ran.returncode == 1
    assert "failover team create begins a team, failover team join enters another robot's" in ran.stderr


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["create", "lab"], "exists"),
        (["enrol", "robot1", "10.0.0.9", "--public-key", KEY], "--replace"),
        (["enrol", "two words", "10.0.0.9", "--public-key", KEY], "cannot name a robot"),
        (["enrol", "robot2", "10.0.0.9", "--public-key", "short"], "not 40"),
        (["enrol", "robot2", "10.0.0.9:x", "--public-key", KEY], "no address"),
        (["enrol", "robot2", "127.0.0.1", "--public-key", KEY], "robot2 has a loopback address, at which robot1 cannot reach it"),
        (["enrol", "robot2", "239.77.1.1", "--public-key", KEY], "239.77.1.1 is a multicast address"),
        (["enrol", "robot2", "0.0.0.0", "--public-key", KEY], "0.0.0.0 is the address of no interface"),
        (["enrol", "robot2", "255.255.255.255", "--public-key", KEY], "is the broadcast address"),
        (["enrol", "robot2", "10.0.0.1", "--public-key", KEY], "robot1 has the beat address 10.0.0.1:7420 already"),
        (["enrol", "robot2", "10.0.0.9", "10.0.0.9", "--public-key", KEY], "10.0.0.9:7420 stands twice"),
        (["invite", "robot2"], "is no member of"),
        (["invite", "robot1"], "is no member of"),
        (["join", "robot2@10.0.0.1:7423/abc"], "copy the line that failover team invite printed"),
    ],
)
def test_a_mistake_with_the_team_is_named_and_changes_nothing(tmp_path: Path, words: list[str], sentence: str) -> None:
    place = ["--directory", str(tmp_path)]
    failover("team", "create", "lab", "--empty", *place)
    failover("team", "enrol", "robot1", "10.0.0.1", "--public-key", KEY, *place)
    before = (tmp_path / "team.toml").read_text()
    ran = failover("team", *words, *place)
    assert ran.returncode == 1
    assert sentence in ran.stderr
    assert (tmp_path / "team.toml").read_text() == before


def test_keys_are_made_by_no_module_of_the_present_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "agent.py").write_text("raise SystemExit('theirs')")
    monkeypatch.chdir(tmp_path)
    assert [len(key) for key in key_pairs.new_pair()] == [40, 40]
