"""The table [board] of team.toml."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from failover.config import strict_toml, team
from failover.config.board import BoardConfig, as_toml, text_of_board
from failover.config.team import Robot, Team
from failover.core.board.item_types import Opaque
from failover.core.board.items import Board, Item
from failover.errors import FileMistakeError, TeamFileError
from tests.failover.core.board.test_item_types import STRUCTS

ROBOTS = '[robots.robot1]\nbeats = ["127.0.0.1:7420"]\nbulk = "127.0.0.1:7421"\n'
BOARD = """# what the team sees
[board]
group = "robots"

# where the ball is
[board.items.ball]
type = { x = "f4", v = "f4[3]", text = "char[16]", pose = { a = "f8" } }
period = 2

[board.items.plan]
type = "msgpack"
size = 512
robots = ["robot*"]
bound_ms = 120
"""


def read(directory: Path, board: str) -> Team:
    """The team of a file with this board."""
    (directory / "team.toml").write_text(f'team = "lab"\n{ROBOTS}{board}')
    return team.read(directory)


def test_items_are_numbered_in_the_order_of_the_file(tmp_path: Path) -> None:
    board = read(tmp_path, BOARD).items()
    assert board.group == "robots"
    assert [item.as_words()["type"] for item in board.items] == [
        "{x:f4,v:f4[3],text:char[16],pose:{a:f8}}",
        "msgpack[512]",
    ]
    assert (board.items[0].period, board.items[1].bound_ms, board.items[1].robots) == (2, 120, ("robot*",))
    assert len(board.terms) == 8


def test_a_team_without_a_board_has_no_items_and_no_terms(tmp_path: Path) -> None:
    assert read(tmp_path, "").items() == Board()
    assert read(tmp_path, "").items().terms == b""


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("period = 2", "period = 0", "12: board.items.ball.period: period 0 is not from 1 to 65536 rounds"),
        ('"f8"', '"f9"', "11: board.items.ball.type: field pose.a: 'f9' is no type"),
        ("size = 512", "siez = 512", "16: unknown key 'siez'; did you mean 'size'?"),
        ('type = "msgpack"', "type = 4", "15: board.items.plan.type: Expected"),
        ('["robot*"]', '"robot*"', "17: board.items.plan.robots: Expected `array`, got `str`"),
        ("items.ball", 'items."b all"', "10: board.items.\"b all\": 'b all' cannot name an item"),
        ("size = 512", "size = 70000", "16: board.items.plan.size: size 70000 is not from 1 to 65536"),
        ("size = 512", "", "15: board.items.plan.type: msgpack needs a size"),
        ("period = 2", 'shared = "x"', "12: board.items.ball.shared: Expected `bool | array`, got `str`"),
        ("period = 2", "banks = 9", "12: board.items.ball.banks: banks 9 is not from 2 to 8"),
        ('group = "robots"', "groups = 3", "7: unknown key 'groups'; did you mean 'group'?"),
    ],
)
def test_a_mistake_names_its_line_and_its_key(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in BOARD
    with pytest.raises(FileMistakeError) as caught:
        read(tmp_path, BOARD.replace(old, new, 1))
    assert f"{tmp_path}/team.toml:{said}" in str(caught.value)


def test_a_robot_that_is_enrolled_leaves_the_board_as_an_operator_wrote_it(tmp_path: Path) -> None:
    before = read(tmp_path, BOARD)
    team.write(tmp_path, team.enrol(before, "robot2", Robot(("127.0.0.1:7422",), "127.0.0.1:7423")))
    after = team.read(tmp_path)
    assert sorted(after.robots) == ["robot1", "robot2"]
    assert after.board == before.board
    assert (tmp_path / "team.toml").read_text().endswith(BOARD)


def test_a_board_that_is_written_in_another_way_is_kept_too(tmp_path: Path) -> None:
    (tmp_path / "team.toml").write_text(f'team = "lab"\nboard.items.ball = {{ size = 64 }}\n{ROBOTS}')
    before = team.read(tmp_path)
    team.write(tmp_path, before)
    assert team.read(tmp_path).items() == before.items()


ITEMS = st.builds(
    Item,
    st.from_regex(r"[a-zA-Z.ä-]{1,8}", fullmatch=True),
    st.one_of(STRUCTS, st.builds(Opaque, st.sampled_from(["bytes", "msgpack", "json"]), st.integers(1, 4096))),
    shared=st.one_of(st.booleans(), st.just(("robot1", "b*"))),
    period=st.integers(1, 9),
    robots=st.sampled_from([("*",), ("robot1",), ()]),
    bound_ms=st.sampled_from([0, 1.5, 120]),
    banks=st.integers(2, 8),
    urgent=st.booleans(),
    transmit=st.booleans(),
)


@settings(max_examples=25)
@given(st.lists(ITEMS, max_size=4, unique_by=lambda item: item.name))
def test_what_is_written_is_read_as_it_was(items: list[Item]) -> None:
    import tempfile

    board = Board(tuple(items), "robots")
    with tempfile.TemporaryDirectory() as directory:
        assert read(Path(directory), as_toml(board)).items() == board


@settings(max_examples=50)
@given(st.text("[]board.items = \"'#\n", max_size=60))
def test_any_text_gives_its_lines_of_the_board(text: str) -> None:
    kept = text_of_board(text)
    assert set(kept.splitlines()) <= {*text.splitlines(), ""}


def test_the_commented_sample_is_a_board(tmp_path: Path) -> None:
    sample = Path(__file__).parents[3] / "systemd" / "board.toml"
    found = strict_toml.read(_under(tmp_path, sample.read_text()), Team)
    assert len(found.items().items) == 4
    assert found.board != BoardConfig()


def _under(directory: Path, text: str) -> Path:
    path = directory / "team.toml"
    path.write_text(f'team = "lab"\n{text}')
    return path


@pytest.mark.parametrize("odd", ["period = " + "1" * 5_000, "period = " + "[" * 5_000, "type = " + "{a=" * 2_000])
def test_a_value_that_no_reader_of_toml_can_hold_is_refused(tmp_path: Path, odd: str) -> None:
    with pytest.raises(FileMistakeError, match=r"team\.toml: this is not TOML: "):
        read(tmp_path, f"[board.items.ball]\n{odd}")


@pytest.mark.parametrize("port", ["1" * 5_000, "65536", "0", "٣", "-1", ""])
def test_a_port_that_cannot_be_is_refused(port: str) -> None:
    with pytest.raises(TeamFileError, match="is no address; write host:port"):
        team.split_address(f"10.0.0.1:{port}", "robot1")


def test_a_team_directory_whose_name_cannot_be_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TeamFileError, match="cannot be read: File name too long"):
        team.read(tmp_path / ("x" * 300))
