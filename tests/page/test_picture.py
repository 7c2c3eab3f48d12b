"""What the page shows of a status: words for the tree, orders with their consequences, changes and nothing but changes."""

from __future__ import annotations

import copy
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from page import picture
from page.picture import Answers, Table, changes, of_component, of_status, standing
from tests.page.status import component, status

NAME = "/lab/robot1/count"
ROBOTS = ["robot1", "robot2"]
ALL = Answers(see={NAME: ""}, operate={NAME: ""})
STATUS = {"team": "lab", "robot": "robot1"}


@pytest.mark.parametrize(
    ("fields", "word"),
    [
        ({}, "protected"),
        ({"standby": "", "protection": "none"}, "alone"),
        ({"protection": "none"}, "degraded"),
        ({"state": "degraded", "protection": "degraded", "notes": ["it opened a GPU"]}, "degraded"),
        ({"contested": ["/var/log/x"]}, "degraded"),
        ({"state": "failed", "role": "none"}, "failed"),
        ({"state": "ended", "role": "none"}, "ended"),
        ({"state": "held", "role": "standby"}, "unknown"),
        ({"state": "restoring"}, "restoring"),
    ],
)
def test_how_safe_a_component_is_in_one_word(fields: dict[str, Any], word: str) -> None:
    found, why = standing(component(**fields))
    assert found == word
    assert (why == "") is (word in ("protected", "restoring", "ended"))


def test_what_the_standby_lacks_is_the_reason() -> None:
    there = component(role="standby", state="held", lacks=["/dev/ttyUSB0 is missing"])
    (row,) = (
        fields for key, fields in of_status(status(component(elsewhere={"robot2": there})), Answers()).items() if NAME in key
    )
    assert (row["word"], row["why"]) == ("degraded", "/dev/ttyUSB0 is missing")


def test_the_reason_of_a_degraded_component_is_what_the_agent_says() -> None:
    assert standing(component(state="degraded", protection="degraded", notes=["it opened a GPU"])) == (
        "degraded",
        "it opened a GPU",
    )


def test_team_robots_and_components_are_rows() -> None:
    table = of_status(status(component(), component(name="/lab/robot1/gone", state="released")), Answers())
    assert set(table) == {"team", "robot:robot1", "robot:robot2", f"component:{NAME}"}
    assert table["robot:robot1"]["here"] and not table["robot:robot2"]["here"]
    assert table[f"component:{NAME}"]["lag_ms"] == 80


def test_orders_that_make_no_sense_now_say_why() -> None:
    orders = of_component(component(), ROBOTS, ALL)["orders"]
    assert orders["handover"]["to"] == ["robot2"] and orders["handover"]["why_not"] == ""
    assert orders["failback"]["why_not"] == "it runs at robot1 already"
    assert orders["promote"]["why_not"] == "it runs at robot1"
    assert orders["start"]["why_not"] == "it has not ended: it is running"
    assert orders["stop"]["why_not"] == "" and "SIGTERM" in orders["stop"]["says"]
    alone = of_component(component(), ["robot1"], ALL)["orders"]
    assert alone["handover"]["why_not"] == "no other robot is heard"


def test_who_has_reserved_a_component_is_told_and_ends_it() -> None:
    free = of_component(component(), ROBOTS, ALL)
    assert free["reserved"] is None and free["orders"]["unreserve"]["why_not"] == "it is not reserved"
    reserved = {"path": NAME, "user": "anna", "why": "new wheels", "until": 1_800_000_000, "left_ms": 77}
    held = of_component(component(reserved=reserved), ROBOTS, ALL)
    assert held["reserved"] == {"user": "anna", "why": "new wheels", "until": 1_800_000_000}, (
        "no figure that changes at each look"
    )
    assert held["orders"]["unreserve"]["why_not"] == "" and held["orders"]["reserve"]["asks"] == ["minutes", "why"]


def test_a_confirmation_names_how_long_it_stands_still_and_what_is_lost() -> None:
    says = of_component(component(), ROBOTS, ALL)["orders"]["handover"]["says"]
    assert "2 ms" in says and "no work is lost" in says and "connections" in says


def test_a_user_without_the_right_sees_the_rule_that_denies() -> None:
    because = "rights.toml:7 denies it to students"
    orders = of_component(component(), ROBOTS, Answers(operate={NAME: because}))["orders"]
    assert {one["why_not"] for one in orders.values()} == {because}


def test_the_value_of_an_item_that_may_not_be_read_does_not_leave_the_robot() -> None:
    item = {"robot": "robot1", "item": "ball", "value": 41, "complaint": ""}
    path = "/lab/robot1/ball"
    (row,) = picture.of_items([item], "lab", Answers(see={path: ""}, read={path: "no rule"})).values()
    assert row["value"] is None and row["complaint"] == "no rule"
    (row,) = picture.of_items([item], "lab", Answers(see={path: ""})).values()
    assert row["value"] is None, "not asked is not allowed"
    (row,) = picture.of_items([item], "lab", Answers(see={path: ""}, read={path: ""})).values()
    assert row["value"] == 41
    for see in ({path: "no rule"}, {}):
        assert picture.of_items([item], "lab", Answers(see=see, read={path: ""})) == {}


def test_a_driver_is_shown_to_those_who_see_it_and_called_by_those_who_may() -> None:
    driver = {"path": "lab/arm"}
    assert picture.of_drivers([driver], Answers(see={"lab/arm": "no rule"}, call={"lab/arm": ""})) == {}
    assert picture.of_drivers([driver], Answers(call={"lab/arm": ""})) == {}
    (row,) = picture.of_drivers([driver], Answers(see={"lab/arm": ""})).values()
    assert row["why_not"] == picture.UNASKED
    (row,) = picture.of_drivers([driver], Answers(see={"lab/arm": ""}, call={"lab/arm": ""})).values()
    assert row["why_not"] == ""


def test_a_task_is_seen_by_those_who_see_its_component() -> None:
    tasks, owners = [{"task": "map"}, {"task": "other"}], {"map": NAME}
    here = "/lab/robot1"
    assert set(picture.of_tasks(tasks, STATUS, owners, Answers(see={NAME: "no rule", here: ""}))) == {"task:other"}
    assert set(picture.of_tasks(tasks, STATUS, owners, Answers(see={NAME: "", here: "no rule"}))) == {"task:map"}
    assert set(picture.of_tasks(tasks, STATUS, owners, Answers(see={NAME: "", here: ""}))) == {"task:map", "task:other"}
    assert picture.of_tasks(tasks, STATUS, owners, Answers()) == {}


tables = st.dictionaries(st.text(max_size=2), st.dictionaries(st.text(max_size=2), st.integers(0, 2), max_size=3), max_size=4)


def applied(before: Table, news: dict[str, Any]) -> Table:
    """What a client has after a message, as page.js does it."""
    found = copy.deepcopy(before)
    for key, fields in news.get("set", {}).items():
        found[key] = {**found.get(key, {}), **fields}
    for key, names in news.get("without", {}).items():
        for name in names:
            del found[key][name]
    for key in news.get("gone", []):
        del found[key]
    return {key: fields for key, fields in found.items() if fields}


@given(tables, tables)
def test_a_client_that_takes_the_changes_has_the_whole(before: Table, after: Table) -> None:
    wanted = {key: fields for key, fields in after.items() if fields}
    assert applied(before, changes(before, after)) == wanted


@given(tables)
def test_without_a_change_nothing_is_sent(table: Table) -> None:
    assert changes(table, copy.deepcopy(table)) == {}
