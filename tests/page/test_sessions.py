"""Sessions: cookies end, and no user shuts another out."""

from __future__ import annotations

import pytest

from page import rate, sessions
from page.errors import TurnedAwayError
from page.limits import PAGE_SESSIONS_MAX, SESSION_MAX_S, SESSION_S, SESSIONS_OF_USER_MAX
from page.rate import Rate, Rates
from page.sessions import Sessions


class Clock:
    """The seconds that pass are the test's."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 1000.0
        for module in (sessions, rate):
            monkeypatch.setattr(module.time, "monotonic", lambda: self.now_s)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


def test_a_session_ends_after_a_day_without_a_request_and_not_while_a_window_is_open(clock: Clock) -> None:
    known = Sessions()
    session, watched = known.begin("anna", 1000), known.begin("ben", 1001)
    watched.live = 1
    clock.now_s += SESSION_S + 1
    assert known.of(session.id) is None and known.of(watched.id) is watched and len(known) == 1
    known.end(watched)
    assert known.of(watched.id) is None and known.of("") is None


def test_a_user_with_many_sessions_loses_its_own_oldest_and_no_other_users(clock: Clock) -> None:
    known = Sessions()
    first = known.begin("ben", 1001)
    own = []
    for _ in range(SESSIONS_OF_USER_MAX + 1):
        clock.now_s += 1
        own.append(known.begin("anna", 1000))
    assert known.of(first.id) is first
    assert known.of(own[0].id) is None and known.of(own[1].id) is own[1]


def test_where_all_sessions_have_a_window_one_more_is_refused_with_the_reason(clock: Clock) -> None:
    known = Sessions()
    for number in range(PAGE_SESSIONS_MAX):
        known.begin(f"user{number}", number).live = 1
    with pytest.raises(TurnedAwayError, match="close one of them") as refused:
        known.begin("one more", 1)
    assert refused.value.status == 503 and len(known) == PAGE_SESSIONS_MAX


def test_a_session_ends_after_a_day_however_much_it_is_used(clock: Clock) -> None:
    known = Sessions()
    session = known.begin("anna", 1000)
    session.live = 1
    clock.now_s += SESSION_MAX_S - 1
    assert known.of(session.id) is session
    clock.now_s += 2
    assert known.is_over(session) and known.of(session.id) is None and len(known) == 0


def test_who_only_watches_whether_a_session_is_over_does_not_prolong_it(clock: Clock) -> None:
    known = Sessions()
    session = known.begin("anna", 1000)
    for _ in range(4):
        clock.now_s += SESSION_S / 3
        over = known.is_over(session)
    assert over


def test_a_rate_lets_some_through_at_once_and_then_some_a_second(clock: Clock) -> None:
    limit = Rate(a_second=10, at_once=3)
    assert [limit.wait_s() for _ in range(3)] == [0, 0, 0]
    assert limit.wait_s() == pytest.approx(0.1)
    clock.now_s += 0.1
    assert limit.wait_s() == 0 and limit.wait_s() > 0
    clock.now_s += 60
    assert [limit.wait_s() > 0 for _ in range(4)] == [False, False, False, True]


def test_each_who_asks_has_a_rate_and_those_who_ask_no_more_are_forgotten(clock: Clock) -> None:
    limit = Rates(a_second=1, at_once=1, most=2)
    assert [limit.wait_s(who) > 0 for who in ("anna", "ben", "anna")] == [False, False, True]
    assert limit.wait_s("carl") == 0 and len(limit._rates) == 2
    assert limit.wait_s("anna") > 0, "the newest are remembered"
