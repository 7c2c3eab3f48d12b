"""Network traffic that should not be believed: it changes nothing, is counted, and `failover status` says so."""

from __future__ import annotations

import contextlib
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from agent.worker.network.replication_link import new_keys
from failover.config import team
from failover.core.frames.frame import HEADER, NUMBER_SIZE, SEAL_SIZE, Body, Reason, Sealer, bodies, body_size_max
from failover.core.frames.roster import roster
from failover.core.wire.messages import Beat, Entry
from tests.e2e import robots, stranger
from tests.e2e.robots import RobotMachine

HOLD = '[components."/demo/robot1/count"]\non_loss = "hold"\n'
"""What happens to robot2 here must not make it take over."""

COUNT = "import time\nfor i in range(1000000):\n    print(i, flush=True)\n    time.sleep(0.01)\n"
HEAD = HEADER.size + SEAL_SIZE
"""Bytes of a frame before its body, in a team of two."""

OTHER_VERSION = """
from failover.core.frames import frame
from failover.core.wire import messages
messages.VERSION += 1
frame.VERSION += 1
"""
"""Run by every Python of an agent before anything else: a release of another protocol version."""

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pair]:
    with robots.two_robots(tmp_path_factory.mktemp("peers"), HOLD) as pair:
        robots.keep_on(pair[1])
        robots.run(pair[0], "count", "/usr/bin/python3", "-S", "-c", COUNT)
        yield pair


@pytest.fixture
def pair(both: Pair) -> Iterator[Pair]:
    """Two robots, the component protected before and after, by the same two processes of robot1's agent, without a gap."""
    until_protected(both)
    before = agent_of(both[0])
    yield both
    until_protected(both)
    assert agent_of(both[0]) == before, "robot1's agent was restarted"
    counted = [int(line) for line in robots.output(both[0], "count").split()]
    assert counted == list(range(len(counted)))


def until_protected(pair: Pair) -> None:
    robots.until(
        lambda: all(robots.answers(robot) and robots.connected(robot) for robot in pair), "the robots to hear each other"
    )
    robots.until(lambda: robots.component(pair[0], "count").get("protection") == "protected", "a checkpoint at robot2")
    stored = robots.checkpoints(pair[1], "count")
    robots.until(lambda: robots.checkpoints(pair[1], "count") > stored, "the next checkpoint")


def agent_of(robot: RobotMachine) -> tuple[Any, ...]:
    status = robot.status()
    return status["life"], status["pid"], status["lanes_pid"]


def refused(robot: RobotMachine) -> dict[str, int]:
    return dict(robot.status()["beats"]["refused"])


def until_refused(robot: RobotMachine, before: dict[str, int], more: dict[Reason, int]) -> None:
    def counted() -> bool:
        now = refused(robot)
        return all(now.get(reason, 0) >= before.get(reason, 0) + count for reason, count in more.items())

    robots.until(counted, f"{more} to be counted by {robot.name} after {before}")


def until_said(robot: RobotMachine, *words: str) -> str:
    """What `failover status` shows there, once it says all the words."""
    shown = ""

    def says() -> bool:
        nonlocal shown
        shown = robots.failover(robot, "status").stdout
        return all(word in shown for word in words)

    try:
        robots.until(says, f"status to say {words}")
    except AssertionError as error:
        raise AssertionError(f"{error}; it shows {shown}") from error
    return shown


def standing(pair: Pair) -> list[tuple[str, str, int]]:
    """What a forged primacy would change, as both robots see it."""
    ones = [robots.component(robot, "count") for robot in pair]
    return [(one["primary"], one["role"], one["epoch"]) for one in ones]


def claim(boot: int) -> Beat:
    """robot2 says that it is primary, of a much higher epoch."""
    return Beat("robot2", boot, 1, 1, 0, 1, (), (Entry("/demo/robot1/count", 3, 1 << 30, "robot2"),))


def sealed(beat: Beat, team_name: str, key: bytes) -> bytes:
    """A frame of robot2's with this beat."""
    parts, _ = bodies(None, beat, (), 0, body_size_max(2))
    return Sealer(beat.sender, team_name, roster(("robot1", "robot2")), beat.boot).seal(parts, [key])[0]


def test_invented_beats_change_nothing_and_are_counted(pair: Pair) -> None:
    before, stood = refused(pair[0]), standing(pair)
    own = sealed(claim(1 << 20), "demo", bytes(range(32)))
    invented = {
        Reason.UNKNOWN_KEY: own,
        Reason.TEAM: sealed(claim(1 << 20), "neighbours", bytes(range(32))),
        Reason.VERSION: own[:2] + b"\x07" + own[3:],
        Reason.NOT_OURS: b"GET / HTTP/1.1\r\n\r\n" * 3,
    }
    stranger.send(pair[0], [frame for frame in invented.values() for _ in range(20)])
    until_refused(pair[0], before, dict.fromkeys(invented, 20))
    assert standing(pair) == stood
    until_said(pair[0], "beats refused", "beats were refused: ", "another version", "another team", "not a frame")


@pytest.mark.root
def test_recorded_beats_altered_or_repeated_change_nothing_and_are_counted(pair: Pair) -> None:
    dice = random.Random(7)
    recorded = stranger.record(pair[0], 50)
    before, stood = refused(pair[0]), standing(pair)
    stranger.send(pair[0], recorded)  # some below the window by now, some inside it
    until_refused(pair[0], before, {Reason.REPLAYED: 50})
    forged = []
    for frame in recorded:
        body = msgspec.msgpack.decode(frame[HEAD:], type=Body)
        assert body.beat is not None
        for boot in (body.beat.boot, body.beat.boot + 1):
            higher = msgspec.structs.replace(body.beat, boot=boot, counter=body.beat.counter + 1_000)
            for beat in (claim(boot), higher):
                forged.append(frame[:HEAD] + msgspec.msgpack.encode(msgspec.structs.replace(body, beat=beat)))
        place = dice.randrange(HEADER.size + NUMBER_SIZE, len(frame))
        forged.append(frame[:place] + bytes([frame[place] ^ 1 << dice.randrange(8)]) + frame[place + 1 :])
    stranger.send(pair[0], forged)
    until_refused(pair[0], before, {Reason.FORGED: len(forged)})
    assert standing(pair) == stood
    until_said(pair[0], "wrong authentication code")
    sure = robots.checkpoints(pair[1], "count")
    robots.until(lambda: robots.checkpoints(pair[1], "count") > sure + 3, "checkpoints to go on")


@pytest.mark.root
def test_beats_recorded_in_an_earlier_life_are_not_believed_in_the_next(pair: Pair) -> None:
    recorded = stranger.record(pair[1], 20)
    robots.stop_agent(pair[1])
    robots.start_agent(pair[1])
    until_protected(pair)
    before, stood = refused(pair[1]), standing(pair)
    stranger.send(pair[1], recorded)
    until_refused(pair[1], before, {Reason.UNKNOWN_KEY: 20})
    assert standing(pair) == stood


def test_a_stranger_at_the_replication_link_is_refused_and_disturbs_nobody(pair: Pair) -> None:
    assert "REFUSED" in stranger.knock(pair[0], "robot2").upper()
    until_said(pair[0], "this robot refused a key that is not in its team.toml on the replication link", "1 of 1 connected")


@contextlib.contextmanager
def another_secret(robot: RobotMachine) -> Iterator[None]:
    """The robot's secret key is not the one that its team knows it by."""
    path = team.secret_key_path(robot.directory / "team", robot.name)
    right = path.with_suffix(".right")
    path.rename(right)
    team.write_secret_key(robot.directory / "team", robot.name, new_keys()[1])
    yield
    right.rename(path)


@pytest.mark.root  # an agent is started again inside its robot
def test_a_peer_with_another_key_is_refused_in_words_at_both_robots(pair: Pair) -> None:
    first, second = pair
    with another_secret(second):
        robots.stop_agent(second)
        robots.start_agent(second)
        until_said(second, "robot1 does not know this robot's key", "this robot's secret key does not belong to its public key")
        until_said(first, "this robot refused a key that is not in its team.toml", "running, unprotected", "dead")
    robots.stop_agent(second)
    robots.start_agent(second)


@pytest.mark.root  # an agent is started again inside its robot
def test_a_peer_of_another_version_is_refused_in_words_at_both_robots(pair: Pair, tmp_path: Path) -> None:
    first, second = pair
    (tmp_path / "sitecustomize.py").write_text(OTHER_VERSION)
    robots.stop_agent(second)
    robots.start_agent(second, PYTHONPATH=str(tmp_path))
    until_said(first, "robot2 speaks version 3, this robot 2; install the same release on both", "running, unprotected")
    until_said(second, "robot1 speaks version 2, this robot 3; install the same release on both")
    robots.until(
        lambda: refused(first).get(Reason.VERSION, 0) > 0 or refused(second).get(Reason.VERSION, 0) > 0, "beats to be refused"
    )
    robots.stop_agent(second)
    robots.start_agent(second)
