"""failover board record and replay, with real programs, kills, full disks: each put once, at its time, as old as it was."""

from __future__ import annotations

import contextlib
import json
import math
import os
import random
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest

pytest.importorskip("mcap")

from mcap.reader import make_reader

import failover
from failover.boards import directory
from failover.boards.board import Board
from failover.boards.received import ReceivedItems
from failover.cli import main
from failover.core.board import layout, recording
from failover.core.board.ages import NO_ERROR_BOUND
from failover.core.frames.frame import Portion
from failover.recording import mcap_file
from failover.recording.follower import Choice, Follower
from failover.recording.mcap_file import NewFile, Recorded
from failover.recording.record import Plan, Recorder
from failover.recording.replay import TURN_S, Player, Source, Stage
from failover.recording.stream import Decisions
from tests.failover.boards.conftest import place as place
from tests.failover.boards.programs import ROOT, program

BALL = failover.Item("ball", {"x": "f8", "n": "u4"}, bound_ms=60_000)
WRITER = """
ball = board.add(Item("ball", {"x": "f8", "n": "u4"}, bound_ms=60_000))
n = 0
while True:
    n += 1
    ball.put({"x": 0.5, "n": n})
    if n == 1:
        say("ready")
    time.sleep(0.004)
"""
AGE_NS = 30_000_000_000
"""Of each value in `recorded_team`: more than the test takes, less than any machine that runs it is up."""
RECORDER = (sys.executable, "-m", "failover", "board", "record")


def now() -> int:
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


def said(capsys: pytest.CaptureFixture[str], *argv: str, status: int = 0) -> tuple[str, str]:
    """Standard output and standard error of one command line."""
    assert main.main(["board", *argv]) == status
    out, err = capsys.readouterr()
    return out, err


def answered(capsys: pytest.CaptureFixture[str], *argv: str) -> Any:
    """What a command line prints as JSON."""
    return json.loads(said(capsys, *argv, "--json")[0])


def messages(path: Path) -> dict[str, list[tuple[Any, Any]]]:
    """Topic → (message, its JSON), as the library's own reader reads a finished file."""
    found: dict[str, list[tuple[Any, Any]]] = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False):
            found.setdefault(channel.topic, []).append((message, json.loads(message.data)))
    return found


@contextmanager
def meanwhile(act: Callable[[], None]) -> Iterator[None]:
    """Run an act again and again in a thread, for as long as the body lasts."""
    is_over = threading.Event()

    def run() -> None:
        while not is_over.wait(0.01):
            act()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()


@contextmanager
def from_robot2(board: Board) -> Iterator[ReceivedItems]:
    """What an agent makes of robot2: its file."""
    received = ReceivedItems(directory.make_peer(board.directory, "robot2", items={7: BALL}, rank=1, state=layout.RUN))
    yield received


def take(received: ReceivedItems, number: int, age_us: int, error_us: int) -> None:
    """As a frame that comes now brings it."""
    octets = layout.struct.pack("<dI4x", number / 2, number)
    received.heard(now())
    assert received.take([Portion(7, age_us, number, octets)], now(), error_us, number) == 1


# --- Record ----------------------------------------------------------------------------------------------------------


def test_each_put_is_recorded_once_with_the_instant_at_which_it_was_produced(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "team.mcap"
    stamps: list[int] = []
    with failover.board() as board, from_robot2(board) as received:
        ball = board.add(BALL)
        board.add(failover.Item("secret", "msgpack", size=99, shared=False)).put({"a": b"\xff"})
        take(received, 9, 2_000_000, 1_500)

        def put() -> None:
            stamps.append(now() - 5_000_000)
            ball.put({"x": math.nan, "n": len(stamps)}, at=stamps[-1])

        with meanwhile(put):
            answer = answered(capsys, "record", str(path), "--for", "1500ms", "--no-decisions")
        robot = board.robot
    found = messages(path)
    own = found[f"/{robot}/ball"]
    seen = [one["number"] for _, one in own]
    assert seen == sorted(set(seen)) and len(seen) > 3
    assert answer["missed"] == seen[-1] - seen[0] + 1 - len(seen)
    assert answer["puts"] == len(own) + 2 and answer["robots"] == sorted([robot, "robot2"]) and answer["items"] == 2
    origins = {message.publish_time - stamps[one["number"] - 1] for message, one in own}
    assert len(origins) == 1, "publish times are the instants of the puts, by one clock"
    assert abs(origins.pop() - (time.time_ns() - now())) < 60_000_000_000
    for message, one in own:
        assert message.sequence == one["number"] == one["value"]["n"] and one["value"]["x"] is None
        assert one["age_us"] == (message.log_time - message.publish_time) // 1000 >= 5_000
    [(message, other)] = found["/robot2/ball"]
    assert other["value"] == {"x": 4.5, "n": 9} and other["age_us"] >= 2_000_000
    assert 1_500 <= other["age_max_us"] - other["age_us"] <= 1_501
    assert found[f"/{robot}/secret"][0][1]["value"] == {"a": "ff"}
    states = found[recording.ROBOTS_TOPIC][0][1]
    assert states["here"] == robot and [one["state"] for one in states["robots"]] == ["run", "run"]


@pytest.mark.parametrize(
    ("text", "kind", "size", "why"),
    [
        ("{x:f5}", layout.STRUCT, 4, "f5"),
        ("{x:f8}", layout.STRUCT, 4, "has 8 bytes, and the table says 4"),
        ("{x:f4}", layout.BYTES, 4, "is a type of kind struct, and the table says bytes"),
    ],
)
def test_an_item_that_is_declared_wrongly_is_recorded_and_replayed_as_bytes(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, kind: int, size: int, why: str
) -> None:
    path = tmp_path / "team.mcap"
    with failover.board() as board, from_robot2(board) as received:
        received.change((), (layout.Wanted(9, "odd", size, kind=kind, digest=7, text=text),))
        take(received, 3, 0, 0)
        assert received.take([Portion(9, 0, 1, b"odd!")], now(), 0, 2) == 1
        _, err = said(capsys, "record", str(path), "--for", "1ms", "--no-decisions")
        assert "item 'odd' of robot2 is told as bytes" in err and why in err and len(err.splitlines()) == 1
    found = messages(path)
    assert found["/robot2/odd"][0][1]["value"] == b"odd!".hex() and found["/robot2/ball"][0][1]["value"]["n"] == 3
    with failover.board() as board:
        replayed = answered(capsys, "replay", str(path), "--pace", "1000")
        assert replayed["puts"] == 2


def test_an_item_that_was_removed_and_added_alike_is_one_channel_and_is_replayed(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    with failover.board() as board:
        recorders = []
        for number, path in enumerate(files):
            ball = board.add(BALL)
            ball.put({"x": 1.0, "n": number})
            recorders.append(Recorder(board, Follower(board, Choice()), Plan(path, 100.0, 0.0)))
            recorders[-1].stream._look()
            board.remove("ball")
            board.add(BALL).put({"x": 1.0, "n": 10 + number})
            recorders[-1].run()
        robot = board.robot
    with files[0].open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None and [one.topic for one in summary.channels.values()] == [f"/{robot}/ball"]
    assert [one["value"]["n"] for _, one in messages(files[0])[f"/{robot}/ball"]] == [0, 10]
    assert answered(capsys, "replay", *map(str, files), "--pace", "1000")["puts"] == 4


def test_an_error_that_is_not_the_files_leaves_a_whole_file(place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "team.mcap"
    with failover.board() as board:
        ball = board.add(BALL)
        ball.put({"x": 1.0, "n": 1})
        recorder = Recorder(board, Follower(board, Choice()), Plan(path, 100.0, 60.0))
        looks = iter([recorder.stream._follower.look])
        monkeypatch.setattr(recorder.stream._follower, "look", lambda: next(looks)())
        with pytest.raises(StopIteration):
            recorder.run()
        robot = board.robot
    assert len(messages(path)[f"/{robot}/ball"]) == 1


def test_only_what_is_chosen_is_recorded(place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with failover.board() as board, from_robot2(board) as received:
        board.add(BALL).put({"x": 1.0, "n": 1})
        board.add(failover.Item("goal", size=4)).put(b"x")
        take(received, 1, 0, NO_ERROR_BOUND)
        choices = {
            "--items b*": {"robot2", board.robot},
            "--robots robot2": {"robot2"},
            f"--robots {board.robot} --items g?al": {board.robot},
        }
        for number, (choice, robots) in enumerate(choices.items()):
            path = tmp_path / f"{number}.mcap"
            answer = answered(capsys, "record", str(path), "--for", "1ms", "--no-decisions", *choice.split())
            assert set(answer["robots"]) == robots and answer["items"] == 1
        _, err = said(capsys, "record", str(tmp_path / "x.mcap"), "--items", "bell", status=1)
        assert "no item is called 'bell'" in err and "ball" in err and not (tmp_path / "x.mcap").exists()


def test_a_file_that_is_full_is_followed_by_one_that_stands_alone(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "team-3.mcap").write_text("another one's")
    with failover.board() as board:
        ball = board.add(failover.Item("ball", size=4000))
        board.add(failover.Item("goal", size=4)).put(b"goal")
        with meanwhile(lambda: ball.put(os.urandom(4000))):
            args = ("--for", "5s", "--max-size", "1KB", "--keep", "2", "--no-decisions", "--rate", "20")
            answer = answered(capsys, "record", str(tmp_path / "team.mcap"), *args)
        robot = board.robot
    files = [Path(one) for one in answer["files"]]
    assert len(files) == 2 and sorted(tmp_path.iterdir()) == sorted([*files, tmp_path / "team-3.mcap"])
    assert tmp_path / "team.mcap" not in files and (tmp_path / "team-3.mcap").read_text() == "another one's"
    for path in files:
        assert messages(path)[f"/{robot}/goal"][0][1]["value"] == b"goal".hex()


def test_a_file_whose_index_is_full_is_followed_by_another_one(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mcap_file, "INDEX_MAX", 6)
    with failover.board() as board:
        items = [board.add(failover.Item(f"item{number}", size=4)) for number in range(4)]
        for item in items:
            item.put(b"x")
        recorder = Recorder(board, Follower(board, Choice()), Plan(tmp_path / "team.mcap", 100.0, 1.5))
        recorder.run()
    assert [one.name for one in recorder.files] == ["team.mcap", "team-2.mcap", "team-3.mcap"][: len(recorder.files)]
    assert len(recorder.files) > 1
    for path in recorder.files[:-1]:
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None
        assert sum(1 + len(one.message_index_offsets) for one in summary.chunk_indexes) == 6


def test_a_killed_recorder_loses_its_last_second_at_most(place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seed = random.randrange(1 << 32)
    print(f"seed {seed}")
    dice = random.Random(seed)
    with failover.board() as board, program(WRITER) as writer:
        writer.hear()
        ball = board.item("ball")
        for life in range(4):
            path = tmp_path / f"{life}.mcap"
            with subprocess.Popen([*RECORDER, str(path), "--no-decisions"], cwd=ROOT) as recorder:
                while not path.exists() or path.stat().st_size < 500:
                    time.sleep(0.01)
                newest, size = ball.get().number, path.stat().st_size
                for _ in range(2):  # the second chunk from here on was begun after that put
                    while path.stat().st_size == size:
                        time.sleep(0.001)
                    size = path.stat().st_size
                time.sleep(dice.uniform(0, 1.2))
                recorder.kill()
            recorded = Recorded(path)
            got = [json.loads(message.data)["number"] for _, channel, message in recorded.messages() if "ball" in channel.topic]
            assert got == sorted(set(got)) and newest <= got[-1] <= ball.get().number
            assert not recorded.loss.is_finished and path.stat().st_size >= size
            assert path.stat().st_size - recorded.loss.tail > 400
            out, _ = said(capsys, "record", "--recover", str(path))
            assert "is whole now" in out and f"{path.name}.before" in out
            (topic,) = [one for one in messages(path) if one.endswith("/ball")]
            assert [one["number"] for _, one in messages(path)[topic]] == got


def limited() -> None:
    """In a child: files of at most 40,000 bytes, as a disk that is full."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, 40_000))


def test_a_full_disk_ends_the_recording_and_keeps_what_was_there(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "team.mcap"
    with failover.board() as board:
        noise = board.add(failover.Item("noise", size=1000))
        with meanwhile(lambda: noise.put(os.urandom(1000))):
            command = [*RECORDER, str(path), "--no-decisions"]
            ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, preexec_fn=limited, check=False)
    assert ran.returncode == 1 and len(ran.stderr.splitlines()) == 1
    assert f"cannot write {path} any more: File too large; it keeps its first {path.stat().st_size} bytes" in ran.stderr
    recorded = Recorded(path)
    count = len(list(recorded.messages()))
    assert count > 0 and recorded.loss.tail == 0
    said(capsys, "record", "--recover", str(path))
    assert sum(len(one) for one in messages(path).values()) == count


@pytest.mark.root
def test_a_file_system_without_room_too(place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "small", disk], check=True)
    try:
        with failover.board() as board:
            noise = board.add(failover.Item("noise", size=1000))
            with meanwhile(lambda: noise.put(os.urandom(1000))):
                _, err = said(capsys, "record", str(disk / "a.mcap"), "--no-decisions", status=1)
        assert "No space left on device" in err
        recorded = Recorded(disk / "a.mcap")
        assert list(recorded.messages()) and recorded.loss.tail == 0
        with contextlib.suppress(OSError), (disk / "full").open("wb", buffering=0) as filler:
            filler.write(bytes(1 << 20))
        _, err = said(capsys, "record", "--recover", str(disk / "a.mcap"), status=1)
        assert "is as it was" in err and sorted(one.name for one in disk.iterdir()) == ["a.mcap", "full"]
    finally:
        subprocess.run(["umount", disk], check=True)


def test_a_signal_ends_a_recording_in_order(place: Path, tmp_path: Path) -> None:
    path = tmp_path / "team.mcap"
    with failover.board() as board:
        board.add(BALL).put({"x": 1.0, "n": 1})
        with subprocess.Popen([*RECORDER, str(path), "--no-decisions"], cwd=ROOT, stdout=subprocess.PIPE, text=True) as recorder:
            while not path.exists() or path.stat().st_size < 500:
                time.sleep(0.01)
            recorder.send_signal(signal.SIGINT)
            out, _ = recorder.communicate()
    assert recorder.returncode == 0 and "1 puts of 1 items of 1 robots" in out
    assert len(messages(path)) == 2


def test_decisions_of_a_robot_that_was_cut_off_are_asked_for_when_it_is_back(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = time.time()
    clock_s = 1000.0
    monkeypatch.setattr("failover.recording.stream.time.monotonic", lambda: clock_s)
    team = ("robot1", "robot2")
    lines: list[dict[str, Any]] = [
        {"robot": robot, "life": 1, "number": n, "at": now_s + 10 * n} for robot in team for n in range(1, 7)
    ]
    turn = 0
    cut = {2, 3, 4, 5}

    def ask(age_ms: int) -> dict[str, Any]:
        """As an agent answers after 10 s times ``turn``; robot2 is cut off in some turns."""
        there = [robot for robot in team if robot == "robot1" or turn not in cut]
        known_s = now_s + 10 * turn
        story = [one for one in lines if one["robot"] in there and known_s - age_ms / 1000 <= one["at"] <= known_s]
        asked.append(age_ms)
        return {"robots": [{"robot": robot, "answered": robot in there} for robot in team], "story": story}

    decisions = Decisions(ask)
    got: list[tuple[object, object]] = []
    asked: list[int] = []
    for turn in range(1, 8):  # noqa: B007  # `ask` reads it
        clock_s += 10
        decisions._look()
        got += [(one["robot"], one["number"]) for one in decisions.taken()]
    assert sorted(got) == [(one["robot"], one["number"]) for one in lines]
    assert asked == [15_000] * 6 + [55_000] + [15_000], "the long question is asked once"


# --- Replay ----------------------------------------------------------------------------------------------------------


def recorded_team(path: Path, here: str = "robot1", format_: str = recording.FORMAT) -> None:
    """Two robots: robot1 recorded; ten puts of each, 100 ms between two, 30 s old, robot2's with 5 ms of doubt."""
    file = NewFile(path, "test")
    states = file.channel(recording.ROBOTS_TOPIC, recording.ROBOTS_SCHEMA, {})
    robots = (recording.Robot(here, "run", 0, 0), recording.Robot("robot2", "remove", 30_000, 1))
    wanted = layout.wanted_of(BALL, 0)
    channels = {robot: recording.Channel(robot, wanted) for robot in (here, "robot2")}
    numbers = {
        robot: file.channel(one.topic, recording.item_schema(one), recording.metadata_of(one) | {recording.FORMAT_KEY: format_})
        for robot, one in channels.items()
    }
    for step in range(10):
        log_ns = 1_700_000_000_000_000_000 + step * 100_000_000
        for robot, one in channels.items():
            octets = layout.struct.pack("<dI4x", step / 2, step)
            error_ns = 0 if robot == here else 5_000_000
            put = recording.Coder(one).put_of(octets, 1000 + step, AGE_NS, AGE_NS + error_ns, False)
            file.add(numbers[robot], log_ns, log_ns - AGE_NS, put.number, recording.encode(put))
    file.add(states, log_ns, log_ns, 0, recording.encode(recording.Robots(here, robots)))
    file.close()


def test_programs_see_a_replayed_team_at_its_pace_with_its_ages(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "team.mcap"
    recorded_team(path)
    reader = """
ball = board.item("ball")
own, other = ball.get(), ball.get("robot2")
say(board.robot, *board.robots(), own.value["n"], own.age_ns, own.age_max_ns - own.age_ns)
say(other.age_ns, other.age_max_ns - other.age_ns)
hear()
newest = ball.get("robot2")
state = board.robots()["robot2"].state
board.close()
say(newest.value["n"], state)
"""
    command = [sys.executable, "-m", "failover", "board", "replay", str(path), "--pace", "0.2", "--loop"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as replay:
        assert replay.stdout is not None
        assert "replaying 20 puts of 2 items of robot1, robot2, 0.9 s" in replay.stdout.readline()
        with program(reader) as running:
            here, *robots, step, age, doubt = running.hear().split()
            other_age, other_doubt = running.hear().split()
            assert (here, robots) == ("robot1", ["robot1", "robot2"]) and 0 <= int(step) <= 9
            assert int(age) >= AGE_NS and int(doubt) == 0
            assert int(other_age) >= AGE_NS and 4_999_000 <= int(other_doubt) <= 5_001_000
            replay.send_signal(signal.SIGTERM)
            replay.wait()
            running.tell("")
            assert running.hear().split()[1] == "not"
        assert replay.returncode == 0


def test_a_replay_gives_every_value_in_order(place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "team.mcap"
    recorded_team(path, here=directory.this_robot())
    with failover.board() as board:
        board.add(BALL)
        answer = answered(capsys, "replay", str(path), "--pace", "1000")
        assert answer["puts"] == 20 and answer["lost"] == [] and answer["span_s"] == 0.9
        ball = board.item("ball")
        assert [ball.get(robot).value["n"] for robot in (None, "robot2")] == [9, 9]
        assert (ball.get().number, ball.get("robot2").number) == (10, 10)
        assert board.robots()["robot2"].state == "not"
        assert ball.get().age_ns >= AGE_NS
        path.write_bytes(path.read_bytes()[:-100])
        assert answered(capsys, "replay", str(path), "--pace", "1000")["lost"][0].startswith(f"{path}: it was not finished")


def test_an_item_that_a_program_writes_is_not_overwritten(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "team.mcap"
    recorded_team(path, here=directory.this_robot())
    with failover.board() as board, program(WRITER) as writer:
        writer.hear()
        before = board.item("ball").get().number
        _, err = said(capsys, "replay", str(path), status=1)
        assert f"item 'ball' is written by pid {writer.pid}" in err
        assert board.item("ball").get().number >= before and list(board.robots()) == [board.robot]


def test_an_agents_board_is_left_alone_unless_names_have_a_prefix(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "team.mcap"
    recorded_team(path)
    place.mkdir()
    for name, flags in ((directory.PRIVATE_NAME, layout.PRIVATE), (directory.OWN_NAME, layout.OWN)):
        directory.make_file(place / name, flags, "robot1", items={0: BALL} if flags == layout.OWN else {})
    try:
        _, err = said(capsys, "replay", str(path), status=1)
        assert "is an agent's" in err and "--as PREFIX" in err
        with failover.board() as board:
            assert board.names() == ["ball"]
            _, err = said(capsys, "replay", str(path), "--as", "a/b", status=1)
            assert "cannot name an item" in err and board.names() == ["ball"]
            command = [sys.executable, "-m", "failover", "board", "replay", str(path), "--as", "old", "--loop"]
            with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as replay:
                assert replay.stdout is not None
                replay.stdout.readline()
                _, err = said(capsys, "replay", str(path), "--as", "new", status=1)
                assert f"pid {replay.pid} replays a recording" in err
                reading = board.item("old.robot2.ball").wait(timeout=30)
                assert reading.age_ns >= AGE_NS and reading.robot == "robot1"
                assert set(board.names()) == {"ball", "old.robot1.ball", "old.robot2.ball"}
                replay.terminate()
                replay.communicate()
            assert replay.returncode == 0 and board.names() == ["ball"]
            with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as replay:
                assert replay.stdout is not None
                replay.stdout.readline()
                replay.kill()
            board.add(failover.Item("old.robot9.goal", size=4, shared=False))
            board.add(failover.Item("old.mine.goal", size=4, shared=False)).put(b"mine")
            board.add(failover.Item("old.mine", size=4, shared=False))
            assert len(board.names()) == 6
            rows = board.ensured().files[1].read_header().count
            answered(capsys, "replay", str(path), "--as", "old", "--pace", "1000")
            assert board.names() == ["ball", "old.mine.goal", "old.mine"], "one that a program writes stays"
            assert board.ensured().files[1].read_header().count == rows, "items that were left are used again"
    finally:
        for one in place.iterdir():
            one.unlink()
        place.rmdir()


def test_a_replay_leaves_room_for_the_programs_of_an_agents_board(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "team.mcap"
    recorded_team(path)
    place.mkdir()
    for name, flags in ((directory.PRIVATE_NAME, layout.PRIVATE), (directory.OWN_NAME, layout.OWN)):
        directory.make_file(place / name, flags, "robot1", capacity=8)
    try:
        for _ in range(3):
            answered(capsys, "replay", str(path), "--as", "old", "--pace", "1000")
        _, err = said(capsys, "replay", str(path), "--as", "old", status=1)
        assert "has room for 2 private items" in err and "start the agent anew" in err and len(err.splitlines()) == 1
        with failover.board() as board:
            board.add(failover.Item("mine", size=4, shared=False))
    finally:
        for one in place.iterdir():
            one.unlink()
        place.rmdir()


def test_a_file_that_is_being_recorded_is_replayed_as_it_was_when_it_was_examined(place: Path, tmp_path: Path) -> None:
    path = tmp_path / "team.mcap"
    file = NewFile(path, "test")
    for name in ("ball", "goal"):
        channel = recording.Channel("robot2", msgspec.structs.replace(layout.wanted_of(BALL, 0), name=name))
        put = recording.Coder(channel).put_of(bytes(16), 1, 0, 0, False)
        file.add(file.channel(channel.topic, None, recording.metadata_of(channel)), 1, 1, 1, recording.encode(put))
        file.flush()
        if name == "ball":
            source = Source([path], Choice())
            contents = source.examined()
    assert contents.lost == [f"{path}: it is being recorded: what comes from now on is left out"]
    with Stage(place, contents, "") as stage:
        player = Player(source, contents, stage, 1.0)
        begin_s = time.monotonic()
        player.run(TURN_S)
        assert player.puts == 1 and time.monotonic() >= begin_s + TURN_S, "a turn without a span takes a while"
    file.close()


def test_a_channel_that_cannot_be_read_is_left_out_and_told(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "team.mcap"
    file = NewFile(path, "test")
    wanted = layout.wanted_of(BALL, 0)
    for name in ("ball", "goal", "odd"):
        channel = recording.Channel("robot2", msgspec.structs.replace(wanted, name=name))
        metadata = recording.metadata_of(channel) | ({"type": "{x:f5}"} if name == "odd" else {})
        put = recording.Coder(channel).put_of(bytes(16), 1, 0, 0, False)
        file.add(file.channel(channel.topic, None, metadata), 1, 1, 1, recording.encode(put))
    file.close()
    answer = answered(capsys, "replay", str(path))
    assert answer["puts"] == 2 and len(answer["lost"]) == 1
    assert "the declaration of 'odd'" in answer["lost"][0] and "/robot2/odd is left out" in answer["lost"][0]
    answer = answered(capsys, "replay", str(path), "--items", "ball")
    assert answer["puts"] == 1 and answer["lost"] == []
    _, err = said(capsys, "replay", str(path), "--items", "odd", status=1)
    assert "damaged: the declaration of 'odd'" in err and len(err.splitlines()) == 1


def test_a_recording_of_something_else_is_refused(place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "team.mcap"
    recorded_team(path, format_="2")
    _, err = said(capsys, "replay", str(path), status=1)
    assert f"{path}: it was recorded in format '2', and this release reads format 1" in err
    other = tmp_path / "other.mcap"
    file = NewFile(other, "test")
    file.add(file.channel("/imu", None, {}), 1, 1, 1, b"{}")
    file.close()
    _, err = said(capsys, "replay", str(other), status=1)
    assert f"{other}: no item of a board is recorded there" in err
    assert not place.exists()
