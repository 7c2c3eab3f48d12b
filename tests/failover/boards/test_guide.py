"""docs/board.md: what it tells to type works, as it stands there."""

from __future__ import annotations

import re
from pathlib import Path

from tests.failover.boards.programs import ROOT, program

TEXT = (ROOT / "docs" / "board.md").read_text()


def test_the_two_programs_of_the_guide_exchange_a_ball(place: Path) -> None:
    writer, reader = re.findall(r"```python\n(.*?)```", TEXT, flags=re.DOTALL)
    classes = writer.partition("board = ")[0]
    with program(writer.replace("board = ", "say('begun'); board = ")) as one, program(classes + reader) as two:
        one.hear()
        assert re.fullmatch(r"Ball\(x=[0-9.]+, y=2.0\) [0-9.]+ ms old", two.hear())
        one.process.wait()
        two.process.wait()
    assert not place.exists()


def test_the_calls_of_the_guide_exist() -> None:
    from failover.boards.board import Board
    from failover.boards.item import Item

    assert set(re.findall(r"`board\.(\w+)\(", TEXT)) <= set(dir(Board))
    assert set(re.findall(r"item\.(\w+)\(", TEXT)) <= set(dir(Item))
