"""The count of who talks to whom: equal to what was sent, for an hour, within its limits."""

from __future__ import annotations

import random
from collections import Counter

from failover.core.messaging.traffic import EDGES_MAX, MINUTE_NS, OTHERS, Traffic, who


def test_the_rows_are_the_matrix_of_what_was_sent() -> None:
    dice, traffic = random.Random(7), Traffic()
    counts: Counter[tuple[str, str]] = Counter()
    sizes: Counter[tuple[str, str]] = Counter()
    errors: Counter[tuple[str, str]] = Counter()
    for turn in range(5_000):
        name, verb = f"robot{dice.randrange(1, 4)}/mission", dice.choice(["set", "read"])
        size, is_error, now_ns = dice.randrange(40, 400), dice.random() < 0.1, turn * MINUTE_NS // 100
        traffic.came(f"{name}-{dice.randrange(9_000)}-{turn}", verb, size, now_ns)
        traffic.done(f"{name}-1-1", verb, 1_000_000, now_ns, is_error=is_error)
        counts[name, verb] += 1
        sizes[name, verb] += size
        errors[name, verb] += is_error
    rows = {(row["from"], row["verb"]): row for row in traffic.rows(50 * MINUTE_NS)}
    assert {edge: row["count"] for edge, row in rows.items()} == counts
    assert {edge: row["bytes"] for edge, row in rows.items()} == sizes
    assert {edge: row["errors"] for edge, row in rows.items()} == errors


def test_what_is_older_than_an_hour_is_left_out() -> None:
    traffic = Traffic()
    for minute in (0, 30, 59):
        traffic.came("a", "set", 10, minute * MINUTE_NS)
    assert [traffic.rows(minute * MINUTE_NS)[0]["count"] for minute in (59, 60, 89, 90)] == [3, 2, 2, 1]
    assert traffic.rows(119 * MINUTE_NS) == []


def test_p99_is_at_most_half_too_high_and_never_too_low() -> None:
    dice = random.Random(3)
    for _ in range(200):
        traffic = Traffic()
        took = sorted(int(10 ** dice.uniform(3.1, 9)) for _ in range(dice.randrange(1, 400)))
        for one in took:
            traffic.came("a", "set", 1, 0)
            traffic.done("a", "set", one, 0, is_error=False)
        true_us = took[len(took) - 1 - len(took) // 100] / 1_000
        (row,) = traffic.rows(0)
        assert true_us <= row["p99_us"] <= max(1.5 * true_us + 1, 2)


def test_more_edges_than_there_is_room_for_count_together() -> None:
    traffic = Traffic()
    for number in range(EDGES_MAX + 10):
        traffic.came(f"robot/program{number}x", "set", 1, 0)
    rows = traffic.rows(0)
    assert len(rows) == EDGES_MAX + 1 and next(row["count"] for row in rows if row["from"] == OTHERS) == 10


def test_a_program_that_was_started_anew_is_the_same_one() -> None:
    assert who("robot1/mission-4711-1") == who("robot1/mission-9-3-2") == "robot1/mission"
    assert who("by-hand-0badcafe") == "by hand"


def test_a_sender_without_pid_and_number_is_found_of_any_form() -> None:
    told = {"r/x-12-3": "r/x", "r/x": "r/x", "r/x-": "r/x-", "r/x-1-": "r/x-1-", "r/a-b-7": "r/a-b", "-1-2": "-1-2", "": ""}
    assert {name: who(name) for name in told} == told
