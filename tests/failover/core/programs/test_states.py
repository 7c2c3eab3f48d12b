"""Versions of a program: which may follow which; one is active; what a trial decides."""

from __future__ import annotations

import contextlib
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from failover.core.programs import states, versions
from failover.core.programs.manifest import Health
from failover.core.programs.states import ARROWS, Shelf, State, Version
from failover.core.programs.trial import JOURNAL_MAX, SECOND, Command, Trial, Verdict
from failover.errors import BundleRefusedError, ProgramError

numbers = st.lists(st.integers(0, 20), min_size=1, max_size=4).map(lambda parts: ".".join(map(str, parts)))


@given(numbers, numbers, numbers)
def test_versions_are_ordered_as_their_numbers(one: str, two: str, three: str) -> None:
    found = sorted((one, two, three), key=versions.order)
    assert versions.order(found[0]) <= versions.order(found[1]) <= versions.order(found[2])
    assert versions.order(one + ".0" if one.count(".") < 3 else one) == versions.order(one)


@pytest.mark.parametrize("text", ["", "1.", ".1", "1..2", "v1", "1.2.3.4.5", "-1", "01", "1.02", "9" * 10, "1 ", "١", "1\n"])
def test_what_is_no_version_is_refused(text: str) -> None:
    with pytest.raises(ProgramError, match="is no version"):
        versions.order(text)


@given(numbers, numbers)
def test_an_older_version_than_the_floor_is_refused_and_no_other(version: str, floor: str) -> None:
    is_older = versions.order(version) < versions.order(floor)
    with pytest.raises(BundleRefusedError, match="downgrade") if is_older else contextlib.nullcontext():
        versions.check_no_downgrade("engine", version, "d", floor, [])


def test_one_version_has_one_content() -> None:
    with pytest.raises(BundleRefusedError, match="with another content"):
        versions.check_no_downgrade("engine", "1.0", "e" * 64, "", [("1", "d" * 64)])
    versions.check_no_downgrade("engine", "1", "d" * 64, "7", [("1", "d" * 64)])  # it is here: nothing new comes in


def test_the_table_in_the_document_is_the_table_in_the_code() -> None:
    rows = re.findall(r"^(\w+(?: \w+)?)  +\S.*?(?:  +(.+))?$", str(states.__doc__), flags=re.MULTILINE)
    told = {name: tuple((after or "").split(", ")) for name, after in rows if name in set(State)}
    assert told == {str(state): tuple(map(str, after)) or ("",) for state, after in ARROWS.items()}


ACTS = {
    "verify": lambda one: states.verify(one, "anna"),
    "refuse": lambda one: states.refuse(one, "x"),
    "stage": states.stage,
    "warm": states.warm,
    "cool": lambda one: states.cool(one, "x"),
    "commit": lambda one: states.commit(one, "x"),
}


@given(st.lists(st.tuples(st.sampled_from([*ACTS, "succeed", "fall_back"]), st.integers(1, 4)), max_size=60))
def test_whatever_happens_one_version_is_active_and_each_step_is_an_arrow(steps: list[tuple[str, int]]) -> None:
    shelf = Shelf("engine", "Lab/PWM")
    for number in range(1, 5):
        shelf = states.put(shelf, Version(str(number), str(number) * 64))
    for act, number in steps:
        before, one = shelf, shelf.find(str(number))
        assert one is not None
        try:
            if act == "succeed":
                shelf = states.succeed(shelf, one, "x")
            elif act == "fall_back":
                shelf = states.fall_back(shelf, "x")
            else:
                shelf = states.put(shelf, ACTS[act](one))
        except ProgramError:
            assert shelf is before
        assert sum(each.state is State.ACTIVE for each in shelf.versions) <= 1
        assert bool(before.active) <= bool(shelf.active), "a program that runs is not left without a version"
        assert all(each.state is State.ACTIVE for each in shelf.versions if each.is_committed)


def test_a_rollback_brings_back_the_version_before_and_only_that() -> None:
    shelf = Shelf("engine", "Lab/PWM")
    for number in ("1", "2"):
        shelf = states.put(shelf, states.warm(states.stage(states.verify(Version(number, number), "anna"))))
    shelf = states.succeed(shelf, shelf.versions[0], "first")
    with pytest.raises(ProgramError, match="no version was active before 1"):
        states.fall_back(shelf, "x")
    shelf = states.put(shelf, states.commit(shelf.versions[0], "healthy"))
    assert shelf.floor == "1"
    shelf = states.fall_back(states.succeed(shelf, shelf.versions[1], "new"), "it failed")
    assert [str(one.state) for one in shelf.versions] == ["active", "rolled back"] and shelf.floor == "1"
    with pytest.raises(ProgramError, match="cannot be rolled back"):
        states.fall_back(shelf, "x")


@given(
    st.floats(0, 60),
    st.integers(0, 50),
    st.booleans(),
    st.lists(st.tuples(st.integers(0, 3 * SECOND), st.booleans()), max_size=80),
)
def test_a_trial_ends_after_its_time_and_its_messages_and_replays_each_command_in_order(
    seconds: float, messages: int, asks: bool, events: list[tuple[int, bool]]
) -> None:
    trial = Trial(Health(seconds, messages, "read" if asks else ""), 0)
    now_ns, commands = 0, []
    for count, (after_ns, changes) in enumerate(events):
        now_ns += after_ns
        over = now_ns >= round(seconds * SECOND) and count >= messages
        expected = (Verdict.ASK if asks else Verdict.PASSED) if over else Verdict.WAIT
        assert trial.verdict(now_ns) is expected
        wait_ns = trial.wait_ns(now_ns)
        assert (wait_ns is None) == (count < messages)
        assert wait_ns is None or trial.verdict(now_ns + wait_ns) is not Verdict.WAIT
        trial.handled(Command("set", count), changes=changes)
        commands += [Command("set", count)] if changes else []
    assert list(trial.replay) == commands


def test_a_trial_does_not_remember_without_limit() -> None:
    trial = Trial(Health(86_400), 0)
    for number in range(JOURNAL_MAX):
        assert trial.verdict(0) is Verdict.WAIT
        trial.handled(Command("set", number), changes=True)
    assert trial.verdict(0) is Verdict.PASSED
