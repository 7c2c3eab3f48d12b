"""The lines of ``failover top``: robots, components in the chosen order, tasks, and what a filter leaves."""

from __future__ import annotations

import pytest

from failover.cli.output import task_tree
from failover.cli.output.top_table import COLUMNS, ORDERS, Order, lines
from failover.client.process_use import Use
from tests.failover.cli.output.test_task_tree import OWNERS, STATUS, TASKS

USES = {"/lab/robot1/navigation": Use(0.5, 40_000_000, 2), "/lab/robot1/camera": Use(0.9, 10_000_000, 1)}


def shown(order: Order = "name", wanted: str = "") -> list[str]:
    tree = task_tree.robots("robot1", TASKS, STATUS, OWNERS, USES)
    return [line.cells[0].strip() for line in lines(tree, STATUS, order, wanted)]


def test_each_robot_has_its_components_and_these_their_tasks() -> None:
    tree = task_tree.robots("robot1", TASKS, STATUS, OWNERS, USES)
    found = lines(tree, STATUS)
    assert all(len(line.cells) == len(COLUMNS) for line in found)
    assert len({line.key for line in found}) == len(found), "no two lines have one key"
    assert found[0].cells[:2] == ("robot1 (here)", "live") and found[0].component == ""
    by_key = {line.key: line for line in found}
    navigation = by_key["component /lab/robot1/navigation"]
    assert navigation.cells[0].strip() == "navigation" and navigation.cells[6:8] == ("50%", "40.0 MB")
    tasks = [line for line in found if line.key.startswith("task ")]
    assert {line.key.removeprefix("task ") for line in tasks} == {one.task for one in TASKS}
    assert all(line.component in ("", OWNERS.get(line.key.removeprefix("task "), "")) for line in tasks)


def test_the_largest_comes_first_of_all_orders_but_the_names() -> None:
    def places(order: Order) -> tuple[int, int]:
        found = shown(order)
        return found.index("navigation"), found.index("camera")

    assert places("name") > places("name")[::-1], "camera comes before navigation"
    assert places("cpu")[0] > places("cpu")[1]
    assert places("memory")[0] < places("memory")[1]
    assert {tuple(sorted(shown(order))) for order in ORDERS} == {tuple(sorted(shown()))}, "nothing comes or goes"


@pytest.mark.parametrize(("wanted", "some"), [("navig", "navigation"), ("NAVIG", "navigation"), ("robot2", "robot2")])
def test_a_filter_leaves_what_fits_and_the_robot_above_it(wanted: str, some: str) -> None:
    found = shown(wanted=wanted)
    assert some in found and len(found) < len(shown())
    assert found[0].startswith("robot"), "below its robot"
    assert "camera" not in found or wanted == "robot2"


def test_a_filter_that_nothing_fits_leaves_nothing() -> None:
    assert shown(wanted="zzz") == []
