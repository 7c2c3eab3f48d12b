"""What the page shows of links and of a radio's ring of slots."""

from __future__ import annotations

from typing import Any

import pytest

from page.feeds import charted
from page.picture import Answers, of_status
from page.radio import of_media
from tests.page.status import status


def peer(robot: str, **fields: Any) -> dict[str, Any]:
    told = {"robot": robot, "seen": "run", "missed": 0, "lost": 3, "awaited": 90, "offset_us": 0, "jitter_us": 0}
    return told | {"transit_us": 2_000, "hears": ["robot1"]} | fields


def medium(*peers: dict[str, Any], link: str = "wlan0", **slots: Any) -> dict[str, Any]:
    """A radio as robot2 tells of it."""
    told = {
        "own": "running",
        "why": "",
        "round": 812,
        "count": len(peers) + 1,
        "place": 1,
        "members": sorted(["robot2", *(one["robot"] for one in peers)]),
        "reference": "robot1",
        "round_us": 51_234,
        "offset_us": 148,
        "jitter_us": 61,
        "least_gap_us": 12_000,
        "late_us": 90,
        "late_us_max": 1_200,
        "followed": 0,
        "outside": 0,
        "ignored": 0,
        "deaf": [["robot3", "robot1"]],
        "peers": list(peers),
    } | slots
    return cable(link=link, period_ms=50, slots=told, bytes={"robot1": 900, "robot2": 300, "robot5": 40})


def cable(**fields: Any) -> dict[str, Any]:
    told = {"link": "wire", "cast": "multicast", "because": "", "by_unicast": [], "period_ms": 20, "no_slots": ""}
    return told | {"bytes": {"robot2": 70}, "slots": None} | fields


def test_each_member_has_its_planned_instant_and_what_came_of_it() -> None:
    peers = peer("robot1"), peer("robot3", offset_us=-1_249), peer("robot4", seen="not"), peer("robot6", seen="not")
    rows = of_media([medium(*peers, members=["robot1", "robot2", "robot3", "robot4"])], "robot2")
    assert rows["medium:wlan0"]["round_ms"] == 51.23 and rows["medium:wlan0"]["deaf"] == [["robot3", "robot1"]]
    first, own, third = (rows[f"member:wlan0/robot{number}"] for number in (1, 2, 3))
    assert [one["planned_ms"] for one in (first, own, third)] == [0, 12.5, 25]
    assert (third["offset_ms"], own["offset_ms"], own["here"]) == (-1.25, 0.15, True)
    assert own["hears"] == ["robot1", "robot3"] and third["hears"] == ["robot1"]
    assert (first["bytes"], own["bytes"], third["bytes"]) == (900, 300, 0)
    unheard = rows["member:wlan0/robot4"]
    assert (unheard["place"], unheard["planned_ms"], unheard["seen"]) == (3, 37.5, "not"), "the others hear it: it has a slot"
    assert "member:wlan0/robot6" not in rows, "it was never heard, and has no slot"
    assert rows["member:wlan0/robot5"]["place"] is None, "it speaks without a slot"


def test_the_ring_begins_at_the_reference() -> None:
    rows = of_media([medium(peer("robot1"), peer("robot3"), reference="robot2")], "robot2")
    assert [rows[f"member:wlan0/robot{number}"]["place"] for number in (2, 3, 1)] == [0, 1, 2]


@pytest.mark.parametrize("reference", ["robot1", "robot9"])
def test_who_is_outside_the_round_has_no_place(reference: str) -> None:
    rows = of_media([medium(peer("robot1"), own="listening", members=["robot1"], reference=reference)], "robot2")
    own = rows["member:wlan0/robot2"]
    assert (own["place"], own["planned_ms"], own["seen"]) == (None, None, "not")


def test_links_of_one_interface_and_those_without_any_are_told_apart() -> None:
    rows = of_media([cable(), cable(link="lo"), cable(link="lo"), cable(link="")], "robot1")
    links = [key.removeprefix("medium:") for key in rows if key.startswith("medium:")]
    assert links == ["wire", "lo (2)", "lo (3)", "link (4)"]
    assert rows["member:wire/robot2"]["bytes"] == 70 and rows["medium:wire"]["own"] == ""


def test_only_a_link_with_slots_has_charts() -> None:
    table = of_status(status(media=[medium(peer("robot1")), cable()]), Answers())
    assert charted("medium:wlan0", table["medium:wlan0"]) == [51.23, 2]
    assert charted("medium:wire", table["medium:wire"]) is None
