"""failover board, get, put, top, users, with real programs on a real board."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import failover
from failover.boards import directory
from failover.boards.board import Board
from failover.boards.mapping import MappedFile
from failover.cli import main
from failover.core.board import layout
from failover.core.board.banks import put_carefully
from failover.core.board.item_types import parse
from failover.core.board.item_values import values_of
from failover.core.board.items import Item
from tests.failover.boards.conftest import place as place
from tests.failover.boards.programs import ROOT, program

BALL = Item("ball", {"x": "f4", "v": "f4[2]", "mark": "u1[2]"}, bound_ms=3_600_000)
VALUE = {"x": 1.0, "v": [2.0, 3.0], "mark": "00ff"}


@pytest.fixture
def board(place: Path) -> Iterator[Board]:
    """A board with three items, one of them written, and what robot2 has sent."""
    with failover.board(name="/lab/r/mapper") as opened:
        opened.add(BALL).put({"x": 1.0, "v": [2.0, 3.0], "mark": b"\0\xff"})
        opened.add(Item("goal", size=64))
        opened.add(Item("plan", "msgpack", size=100, shared=False))
        file = directory.make_peer(opened.directory, "robot2", rank=1, state=layout.RUN)
        with file.changing():
            file.add(layout.wanted_of(BALL, 0))
        receive(file, {"x": 5.0, "v": [6.0, 7.0], "mark": b"ab"}, number=9, age_ns=2_000_000_000, error_us=1500)
        yield opened


def receive(file: MappedFile, value: dict[str, Any], number: int, age_ns: int, error_us: int) -> None:
    """What an agent does with an item that came in a frame."""
    record = file.record("ball")
    assert record is not None
    stamp_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - age_ns
    put_carefully(file.place(record), number, values_of(parse(record.text)).pack(value), stamp_ns, error_us)


def said(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str, str]:
    """Exit status, standard output and standard error of one command line."""
    status = main.main(["board", *argv])
    out, err = capsys.readouterr()
    return status, out, err


def answered(capsys: pytest.CaptureFixture[str], *argv: str, status: int = 0) -> Any:
    """What a command line prints as JSON."""
    ended, out, err = said(capsys, *argv, "--json")
    assert (ended, err) == (status, "")
    return json.loads(out)


def test_the_tree_has_every_robot_with_its_items_values_ages_and_states(board: Board, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = said(capsys, "--every-ms", "10")
    lines = out.splitlines()
    assert status == 0
    assert lines[0] == f"board of {board.robot}"
    assert [line.split()[0] for line in lines[2:]] == [board.robot, "├─", "├─", "└─", "robot2", "└─"]
    assert '├─ ball            {"x": 1.0, "v": [2.0, 3.0], "mark": "00ff"}' in lines[3]
    assert "[#.........] 60 min" in lines[3]
    assert "fresh" in lines[3]
    assert "never put" in lines[4]
    assert "[" not in lines[4]
    assert "plan (private)" in lines[5]
    assert '"x": 5.0' in lines[7]


def test_the_tree_as_json_has_what_the_files_say(board: Board, capsys: pytest.CaptureFixture[str]) -> None:
    answer = answered(capsys, "--every-ms", "10")
    items = {(item["robot"], item["item"]): item for item in answer["items"]}
    ball, theirs = items[board.robot, "ball"], items["robot2", "ball"]
    assert answer["robots"]["robot2"] == {"state": "run", "age_ms": None, "rank": 1}
    assert (ball["value"], ball["put"], ball["stale"], ball["area"], ball["rate_per_s"]) == (VALUE, 1, False, "own", 0)
    assert theirs["area"] == "peer"
    assert theirs["age_ms"] >= 2000
    assert abs(theirs["age_max_ms"] - theirs["age_ms"] - 1.5) < 0.01
    assert items[board.robot, "goal"]["put"] == 0
    assert items[board.robot, "goal"]["age_ms"] is None


def test_a_stale_item_is_told_and_ends_with_1(board: Board, capsys: pytest.CaptureFixture[str]) -> None:
    board.add(Item("old", "f4", bound_ms=1)).put(1.0, at=0)
    assert said(capsys, "--every-ms", "10")[0] == 1
    status, out, _ = said(capsys, "get", "old")
    assert status == 1
    assert "stale: its bound is 1.0 ms" in out


def test_one_item_is_got_of_any_robot(board: Board, capsys: pytest.CaptureFixture[str]) -> None:
    assert answered(capsys, "get", "ball")["value"] == VALUE
    theirs = answered(capsys, "get", "robot2/ball")
    assert (theirs["robot"], theirs["put"], theirs["value"]["x"]) == ("robot2", 9, 5.0)
    _, out, _ = said(capsys, "get", f"{board.robot}/ball")
    assert out.startswith('{"x": 1.0, "v": [2.0, 3.0], "mark": "00ff"}  ')
    assert " ms old, at most " in out


@pytest.mark.parametrize(
    ("argv", "kind", "sentence"),
    [
        (["get", "bal"], "BoardError", "has no item 'bal'; did you mean 'ball'?"),
        (["get", "zzz"], "BoardError", "has no item 'zzz'; it has ball, goal, plan"),
        (["get", "robot3/ball"], "BoardError", "there is no robot 'robot3' on this board; did you mean 'robot2'?"),
        (["get", "robot2/goal"], "BoardError", "robot2 has no item 'goal'"),
        (["get", "goal"], "NeverWrittenError", "it was never written"),
        (["put", "robot2/ball", "1"], "BoardError", "robot2 alone writes its items"),
        (["put", "goall", '"00"'], "BoardError", "did you mean 'goal'?"),
        (["put", "goal", "{"], "RequestError", "the value is not JSON"),
        (["put", "goal", "[" * 100_000], "RequestError", "the value is not JSON"),
        (["put", "goal", '"zz"'], "ValueMisfitError", "bytes are written in hexadecimal"),
        (["put", "goal", f'"{"00" * 65}"'], "ValueMisfitError", "65 bytes"),
        (["put", "goal", "7"], "ValueMisfitError", "give bytes"),
        (["put", "plan", json.dumps("x" * 200)], "ValueMisfitError", "the item holds 100"),
        (["put", "ball", '{"x": 1}'], "WriterTakenError", "(/lab/r/mapper)"),
    ],
)
def test_what_cannot_be_is_one_sentence_and_changes_nothing(
    board: Board, argv: list[str], kind: str, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (board.directory / "own").read_bytes()[layout.RECORDS_AT :]
    answer = answered(capsys, *argv, status=1)
    assert answer["error"] == kind
    assert sentence in answer["message"]
    _, out, err = said(capsys, *argv)
    assert out == ""
    assert sentence in err
    after = (board.directory / "own").read_bytes()[layout.RECORDS_AT :]
    changed = [at for at, (old, new) in enumerate(zip(before, after, strict=True)) if old != new]
    refused = layout.REFUSED_FIELD, layout.PID_FIELD  # who tried, and how often he was refused
    assert {at % layout.RECORD_SIZE // 4 * 4 for at in changed} <= {*refused, layout.REFUSED_FIELD + 4}


@pytest.mark.parametrize(
    ("value", "said_why"),
    [
        ('{"x": 1}', "without a field v"),
        ('{"x": 1, "v": [1, 2], "mark": "0000", "y": 1}', "'y' is no field of it; its fields are x, v, mark"),
        ('{"x": "a", "v": [1, 2], "mark": "0000"}', "field x: 'a' is no f4"),
        ('{"x": 1, "v": [1], "mark": "0000"}', "field v: [1] is 1 values, not 2"),
        ('{"x": NaN, "v": [1, 2], "mark": "0000"}', "nan is refused"),
        ("[]", "no table of the fields x, v, mark"),
    ],
)
def test_a_value_of_another_form_names_its_field(
    board: Board, value: str, said_why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    board.add(Item("shot", BALL.layout, finite=True))
    answer = answered(capsys, "put", "shot", value, status=1)
    assert answer["error"] == "ValueMisfitError"
    assert said_why in answer["message"]


def test_a_value_is_put_by_hand(board: Board, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    assert said(capsys, "put", "goal", '"00ff"') == (0, f"{board.robot}/goal: put 1\n", "")
    assert board.item("goal").get().value == b"\0\xff"
    assert answered(capsys, "put", "plan", '{"way": [1, 2.5, "left"]}')["put"] == 1
    assert board.item("plan").get().value == {"way": [1, 2.5, "left"]}
    board.add(Item("shot", BALL.layout))
    text = tmp_value = json.dumps(VALUE)
    import io

    monkeypatch.setattr(sys, "stdin", io.StringIO(text))
    assert said(capsys, "put", "shot", "-")[0] == 0
    assert answered(capsys, "get", "shot")["value"] == json.loads(tmp_value)


def test_the_users_are_told_without_this_command(board: Board, capsys: pytest.CaptureFixture[str]) -> None:
    with program("say('up'); hear()") as other:
        other.hear()
        found = answered(capsys, "users")["users"]
        assert {one["pid"] for one in found} >= {other.pid}
        assert any(one["name"] == "/lab/r/mapper" for one in found)
        assert len(found) == 2
        other.kill()
    assert len(answered(capsys, "users")["users"]) == 1
    assert said(capsys, "users")[1].startswith(f"1 programs use the board of {board.robot}\n")


def test_rates_and_ages_are_measured(board: Board, capsys: pytest.CaptureFixture[str]) -> None:
    writer = """
item = board.add(Item('fast', 'u8'))
say('up')
n = 0
while True:
    item.put(n); n += 1; time.sleep(0.005)
"""
    with program(writer) as other:
        other.hear()
        while True:  # a busy machine may keep the writer from its turn
            items = {
                item["item"]: item for item in answered(capsys, "top", "--every-ms", "400")["items"] if item["robot"] != "robot2"
            }
            if items["fast"]["rate_per_s"]:
                break
        assert items["ball"]["rate_per_s"] == 0
        assert items["fast"]["age_p50_ms"] <= items["fast"]["age_p99_ms"]
        _, out, _ = said(capsys, "top", "--every-ms", "100")
        assert f"{board.robot}/fast" in out.splitlines()[2]
        assert "/s" in out.splitlines()[2]


def lines_of(*argv: str) -> Iterator[str]:
    """The lines of a command that runs until it is ended."""
    command = [sys.executable, "-m", "failover", "board", *argv]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT) as running:
        assert running.stdout is not None
        try:
            yield from running.stdout
        finally:
            running.terminate()


def test_each_new_value_is_told(board: Board) -> None:
    item = board.item("ball")
    lines = lines_of("get", "ball", "--watch", "--json")
    numbers = [json.loads(next(lines))["put"]]
    for x in (2.0, 3.0):
        item.put({"x": x, "v": [0, 0], "mark": b"ab"})
        answer = json.loads(next(lines))
        assert answer["value"]["x"] == x
        numbers.append(answer["put"])
    assert numbers == [1, 2, 3]
    lines.close()  # type: ignore[attr-defined]


def test_the_tree_is_told_again_and_again(board: Board) -> None:
    lines = lines_of("--watch", "--every-ms", "50", "--json")
    assert [json.loads(next(lines))["robot"] for _ in range(3)] == [board.robot] * 3
    board.remove("goal")
    board.add(Item("later", "f8"))
    while "later" not in [item["item"] for item in json.loads(next(lines))["items"]]:
        pass
    assert "goal" not in [item["item"] for item in json.loads(next(lines))["items"]]
    lines.close()  # type: ignore[attr-defined]


def test_a_damaged_item_is_told_and_hides_no_other(board: Board, capsys: pytest.CaptureFixture[str]) -> None:
    board.add(Item("broken", "json", size=20)).put([1])
    file = MappedFile.open(board.directory / "own", writable=True)
    record = file.record("broken")
    assert record is not None
    put_carefully(file.place(record), 2, b"{no json", time.clock_gettime_ns(time.CLOCK_BOOTTIME), 0)
    file.close()
    answer = answered(capsys, "--every-ms", "10", status=1)
    items = {item["item"]: item for item in answer["items"] if item["robot"] == board.robot}
    assert "are no json that was expected" in items["broken"]["complaint"]
    assert items["ball"]["value"] == VALUE
    assert "are no json" in said(capsys, "--every-ms", "10")[1]


def test_looking_makes_no_board(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for argv in ([], ["get", "x"], ["put", "x", "1"], ["top"], ["users"]):
        assert "there is no board in" in answered(capsys, *argv, status=1)["message"]
    assert not place.exists()
