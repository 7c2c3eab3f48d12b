"""`failover why` for a reader who was not there: the lines below a decision, which robot told it, and omitted lines."""

from __future__ import annotations

import argparse
from typing import Any

import pytest

from failover.cli.arguments.shared import ago
from failover.cli.verbs.why import paragraph, sighting, told_of_robots

SILENT: dict[str, Any] = {
    "robot": "robot1",
    "state": "dead",
    "silent_ms": 221.4,
    "limit_ms": 220.0,
    "links": {"eth0": 221.4, "wlan0": 230.2},
    "hears_us": False,
    "says": "primary, epoch 1, primary robot1",
    "life": 4,
    "beat": 17,
}
CLAIM: dict[str, Any] = {
    "at": 0.0,
    "doubt_ms": 0.0,
    "robot": "robot2",
    "component": "/lab/robot1/mapper",
    "did": "robot2 claims epoch 2, to run it from its newest checkpoint: no robot runs it",
    "life": 1,
    "number": 9,
    "repeats": 0,
    "epoch_before": 1,
    "epoch": 2,
    "state": "claiming",
    "late_ms": 0.2,
    "lease_left_ms": None,
    "checkpoint": 17,
    "checkpoint_age_ms": 310.0,
    "output_pending": None,
    "seen": [SILENT],
}


def facts_of(**changed: Any) -> list[str]:
    return [line.removeprefix("    - ") for line in paragraph({**CLAIM, **changed}).splitlines()[2:]]


def test_a_decision_is_told_with_what_was_seen_the_epochs_and_what_it_cost() -> None:
    head, did, *_ = paragraph(CLAIM).splitlines()
    assert head.endswith("  robot2  /lab/robot1/mapper") and did.strip() == CLAIM["did"]
    assert facts_of() == [
        "robot1: counted as dead, silent for 221 ms (the limit is 220 ms) (eth0 221 ms, wlan0 230 ms); "
        "it said: primary, epoch 1, primary robot1",
        "here: claiming, epoch 1 → 2",
        "newest checkpoint: 17, 310 ms old: a takeover from it loses the work since then",
    ]


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"lease_left_ms": 90.0, "state": "primary"}, "here: primary, epoch 1 → 2, may act for 90 ms more"),
        ({"lease_left_ms": 0.0, "state": "frozen"}, "here: frozen, epoch 1 → 2, its lease is over"),
        ({"checkpoint": None}, "no checkpoint yet: a takeover loses all work"),
        ({"checkpoint_age_ms": None}, "newest checkpoint: 17"),
        ({"output_pending": 1_204}, "output in no checkpoint: 1.2 KB"),
        ({"late_ms": 340.0}, "its own loop had been late by 340 ms"),
        ({"repeats": 7}, "the line before it was said 7 more times"),
        ({"component": "", "late_ms": 0.0}, facts_of()[0]),
    ],
)
def test_what_the_robot_knew_is_a_sentence_each(changed: dict[str, Any], said: str) -> None:
    assert said in facts_of(**changed)


def test_a_robot_that_lives_and_does_not_hear_us_is_told_so() -> None:
    alive = {**SILENT, "state": "alive", "silent_ms": 12.0, "links": {"eth0": 12.0}, "says": ""}
    assert sighting(alive) == "robot1: alive, silent for 12 ms (the limit is 220 ms) on eth0; it does not hear this robot"
    assert sighting({**SILENT, "state": "unheard"}).startswith("robot1: not heard yet")


def test_who_did_not_answer_and_whose_clock_is_wrong_is_said() -> None:
    exact: dict[str, Any] = {
        "answered": True,
        "reason": "",
        "lines": 3,
        "damaged": 0,
        "clock_offset_ms": 0.1,
        "clock_doubt_ms": 0.3,
    }
    told = told_of_robots(
        [
            {**exact, "robot": "robot1"},
            {**exact, "robot": "robot2", "clock_offset_ms": -5_002.0},
            {**exact, "robot": "robot3", "damaged": 2},
            {**exact, "robot": "robot4", "answered": False, "reason": "the replication link is connecting"},
        ]
    )
    assert told.splitlines() == [
        "robot2: its clock is 5.002 s behind this robot's (± 0.3 ms); all times above are this robot's",
        "robot3: 2 lines of its event log cannot be read any more",
        "robot4 did not send its event log: the replication link is connecting",
    ]


SPANS = (("90s", 90_000), ("10min", 600_000), ("2h", 7_200_000), ("3d", 259_200_000), ("5ms", 5))


@pytest.mark.parametrize(("text", "age_ms"), SPANS)
def test_a_span_of_time_is_read_as_people_write_it(text: str, age_ms: int) -> None:
    assert ago(text) == age_ms


@pytest.mark.parametrize("text", ["", "10", "min", "0s", "-5s", "1w", "5 s", "99999999999h", "1.5h"])
def test_what_is_no_span_of_time_is_refused(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="write 90s, 10min, 2h or 3d"):
        ago(text)
