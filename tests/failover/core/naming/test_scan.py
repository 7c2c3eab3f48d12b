"""Names reach every process, whatever is cut, killed or lost; in virtual time."""

from __future__ import annotations

import pytest

from failover.core.naming import records, scan, tables
from failover.core.naming.records import Record
from failover.core.naming.scan import SECOND, Ask, Digest, Pages, Row, Scan, Terms
from failover.core.naming.tree import Reach
from tests.failover.core.naming.town import Town, record

SCAN_S = Terms().scan_ns / SECOND
ONE_SCAN_S = 1.1 * SCAN_S + 2
"""The longest scan, and a second for each of the asks."""


def robots(count: int) -> list[str]:
    return [f"robot{number}" for number in range(1, count + 1)]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_eighty_robots_with_fifty_names_each_take_little_bandwidth_at_rest_and_know_all_after_a_split() -> None:
    names = robots(80)
    town = Town(1, names, names=50)
    town.run(3 * SCAN_S)
    assert town.wrong(names, names) == []
    town.sent.clear()
    town.came.clear()
    town.run(100)
    worst = max((town.sent[one] + town.came[one]) / 100 for one in names)
    print(f"at rest {worst / 1_000:.1f} kB/s a robot, both directions")
    assert worst <= 20_000
    town.parts = {one: number % 2 for number, one in enumerate(names)}
    town.run(300)
    for one in names:
        town.scans[one].put(record(one, 0, changed="in the split"), town.now_ns)
        town.scans[one].put(record(one, 99), town.now_ns)
        town.scans[one].remove(record(one, 1).path, town.now_ns)
    town.run(300)
    halves = [[one for one in names if town.parts[one] == part] for part in (0, 1)]
    for half, other in (halves, halves[::-1]):
        assert town.wrong(half, half) == []
        assert {town.scans[half[0]].reach(town.now_ns)[one] for one in other} == {Reach.UNREACHABLE}
    town.parts = {}
    town.run(ONE_SCAN_S)
    assert town.wrong(names, names) == []
    assert {reach for one in names for reach in town.scans[one].reach(town.now_ns).values()} == {Reach.LIVE}


def test_whichever_process_is_killed_the_rest_resolve_all_others() -> None:
    for victim in robots(5):
        town = Town(2, robots(5), names=3)
        town.run(SCAN_S)
        town.kill(victim)
        rest = [one for one in robots(5) if one != victim]
        assert town.wrong(rest, rest) == []
        town.run(3.3 * SCAN_S)
        assert town.wrong(rest, rest) == []
        assert town.scans[rest[0]].reach(town.now_ns)[victim] is Reach.UNREACHABLE
        assert town.resolves(rest[0], record(victim, 0).path) == victim
        town.run(601)
        assert town.resolves(rest[0], record(victim, 0).path) == ""
        town.run(601)
        assert all(victim not in town.scans[one].reach(town.now_ns) for one in rest)


def test_a_newcomer_that_knows_one_robot_knows_all_and_all_know_it() -> None:
    town = Town(3, robots(10), names=5)
    town.run(SCAN_S)
    town.add("robot11", names=5, seeds=["robot4"])
    town.run(0.1)
    assert town.wrong(["robot11"], robots(10)) == []
    town.run(ONE_SCAN_S)
    assert town.wrong(robots(11), robots(11)) == []


def test_processes_that_know_no_address_find_each_other_by_multicast() -> None:
    town = Town(4, [], names=0)
    for one in robots(4):
        town.add(one, names=2, seeds=[], multicast=True)
    town.run(ONE_SCAN_S)
    assert town.wrong(robots(4), robots(4)) == []


def test_an_urgent_change_is_known_to_all_within_half_a_second_another_one_within_a_scan() -> None:
    town = Town(5, robots(20), names=5)
    town.run(5)
    town.scans["robot3"].put(record("robot3", 7), town.now_ns, urgent=True)
    town.scans["robot3"].remove(record("robot3", 1).path, town.now_ns, urgent=True)
    town.wake("robot3")
    town.run(0.5)
    assert town.wrong(robots(20), ["robot3"]) == []
    town.scans["robot9"].put(record("robot9", 8), town.now_ns)
    town.run(ONE_SCAN_S)
    assert town.wrong(robots(20), ["robot9"]) == []


def test_a_third_of_all_messages_lost_delays_and_breaks_nothing() -> None:
    town = Town(6, robots(10), names=20, loss=0.3)
    town.run(3 * SCAN_S)
    assert town.wrong(robots(10), robots(10)) == []
    assert set(town.scans["robot1"].reach(town.now_ns).values()) == {Reach.LIVE}


def test_an_origin_that_only_a_neighbour_hears_stays_live() -> None:
    town = Town(7, robots(3), names=2)
    town.run(SCAN_S)
    honest = town._carry
    town._carry = lambda sender, to, content: None if {sender, to} == {"robot1", "robot3"} else honest(sender, to, content)  # type: ignore[method-assign]
    town.run(5 * SCAN_S)
    assert town.scans["robot1"].reach(town.now_ns)["robot3"] is Reach.LIVE
    town.scans["robot3"].put(record("robot3", 9), town.now_ns)
    town.run(2 * ONE_SCAN_S)
    assert town.wrong(["robot1"], ["robot3"]) == []


def test_a_table_of_many_pages_comes_whole() -> None:
    town = Town(8, ["robot1"], names=2_000)
    town.add("robot2", names=1, seeds=["robot1"])
    town.run(1)
    assert town.wrong(["robot2"], ["robot1"]) == []
    assert town.sent["robot1"] > 7 * 64_000


def test_many_removed_names_are_forgotten_and_come_back_from_no_robot() -> None:
    town = Town(9, robots(4), names=3)
    town.run(SCAN_S)
    town.parts = {"robot4": 1}
    one = town.scans["robot1"]
    for number in range(10, 200):
        one.put(record("robot1", number), town.now_ns)
        one.remove(record("robot1", number).path, town.now_ns)
    one.remove(record("robot1", 0).path, town.now_ns)
    assert len(one.own.entries) <= 70
    town.run(2 * SCAN_S)
    town.parts = {}
    town.run(ONE_SCAN_S)
    assert town.wrong(robots(4), ["robot1"]) == []


def test_a_robot_whose_clock_was_set_back_wins_over_its_own_past() -> None:
    town = Town(10, robots(3), names=5)
    town.run(SCAN_S)
    town.kill("robot2")
    town.add("robot2", names=2, seeds=robots(3), boot=0)
    town.run(ONE_SCAN_S)
    assert town.wrong(robots(3), robots(3)) == []
    assert town.scans["robot2"].outbid == 1


def test_what_stops_to_show_that_it_lives_is_withdrawn() -> None:
    one = Scan("robot1", 1, 0)
    one.put(Record("Lab/robot1/PWM", lease_s=5), 0)
    one.renew("Lab/robot1/PWM", 18 * SECOND, 5)
    one.tick(one.next_ns())
    one.tick(one.next_ns())
    assert len(one.tree(one.next_ns())) == 1 if one.next_ns() < 23 * SECOND else True
    one.tick(one.next_ns())
    assert len(one.tree(one.next_ns())) == 0


def test_nothing_odd_raises_and_nothing_odd_is_believed() -> None:
    one = Scan("robot1", 5, 0, address="a")
    one.put(Record("Lab/robot1/PWM"), 0)
    for content in (b"", b"\xc0", b"\x93\xa1d\xa1x\xc0", b"[" * 100_000, scan.encode(Digest("x", (Row("robot2", 1 << 62, 1),)))):
        assert scan.decode(content) is None
    page = scan.Page("robot1", 9, 0, 3, "x", 1, 0, ())
    assert one.heard(Pages("x", (page,), ("robot1", "robot7")), 1) == []
    assert one.own.boot == 5
    lying = scan.Page("robot2", 1, 0, 1, "x", 1, 0, (scan.Entry("Lab/robot2/PWM", 1, b"\xff no record"),))
    one.heard(Pages("x", (lying,)), 1)
    assert len(one.tree(1)) == 1
    assert one.heard(Ask("x", (Row("nobody", 1, 1),)), 1) == []


def test_an_answer_without_anything_new_ends_the_asking() -> None:
    one = Scan("robot1", 1, 0, address="a")
    old = scan.Page("robot2", 1, 0, 1, "b", 1, 0, (scan.Entry("Lab/robot2/PWM", 1),))
    assert len(one.heard(Pages("b", (old,), ("robot2",)), 1)) == 1
    assert one.heard(Pages("b", (old,), ("robot2",)), 2) == []


def nested(depth: int) -> bytes:
    """A record with a schema of a verb so deep; its size is within the limit of a body."""
    whole = records.pack(Record("lab/robot2/PWM", verbs={"set": 1}))
    assert whole.endswith(b"\xa3set\x01")
    return whole[:-1] + b"\x91" * depth + b"\x01"


@pytest.mark.parametrize("body", [nested(4_000), nested(12_000), b"\x81\xa4path\xa2\xff\xff", b"\x81\xa2\xff\xff\x01", b""])
def test_a_body_that_is_no_record_is_no_name_and_ends_no_process_that_hears_of_it(body: bytes) -> None:
    assert records.unpack(body) is None
    ours = Scan("robot1", 1, 0)
    ours.put(Record("lab/robot1/PWM"), 1)
    page = tables.Page("robot2", 1, 0, 2, "", 1, 0, (tables.Entry("lab/robot2/PWM", 1, body), tables.Entry("x/y", 2, GOOD)))
    ours.heard(Pages("tcp://10.0.0.2:1", (page,)), 2)
    assert [one.record.path for one in ours.tree(3).under()] == ["lab/robot1/PWM", "x/y"]


GOOD = records.pack(Record("x/y"))
