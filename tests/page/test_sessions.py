"""Sessions and logins: cookies end, no user shuts another out, and guesses of a password become slow."""

from __future__ import annotations

import pytest

from failover.config.page import hashed, is_password
from page import rate, sessions
from page.errors import TurnedAwayError
from page.limits import PAGE_SESSIONS_MAX, SESSION_S, SESSIONS_OF_USER_MAX
from page.rate import Rate
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


def test_a_password_is_kept_as_a_digest_with_a_salt_of_its_own() -> None:
    one, other = hashed("swordfish"), hashed("swordfish")
    assert one != other and "swordfish" not in one
    assert is_password("swordfish", one) and is_password("swordfish", other)
    assert not is_password("swordfisch", one) and not is_password("", one)
    assert not is_password("x", "scrypt:16384:8:1:!!!!") and not is_password("x", "")


def test_a_line_that_would_take_all_memory_is_no_password() -> None:
    assert not is_password("x", f"scrypt:4194304:99:1:{'A' * 24}:{'A' * 44}")


def test_a_session_ends_after_a_day_without_a_request_and_not_while_a_window_is_open(clock: Clock) -> None:
    known = Sessions({})
    session, watched = known.begin("anna", 1000), known.begin("ben", 1001)
    watched.live = 1
    clock.now_s += SESSION_S + 1
    assert known.of(session.id) is None and known.of(watched.id) is watched and len(known) == 1
    known.end(watched)
    assert known.of(watched.id) is None and known.of("") is None


def test_a_user_with_many_sessions_loses_its_own_oldest_and_no_other_users(clock: Clock) -> None:
    known = Sessions({})
    first = known.begin("ben", 1001)
    own = []
    for _ in range(SESSIONS_OF_USER_MAX + 1):
        clock.now_s += 1
        own.append(known.begin("anna", 1000))
    assert known.of(first.id) is first
    assert known.of(own[0].id) is None and known.of(own[1].id) is own[1]


def test_where_all_sessions_have_a_window_one_more_is_refused_with_the_reason(clock: Clock) -> None:
    known = Sessions({})
    for number in range(PAGE_SESSIONS_MAX):
        known.begin(f"user{number}", number).live = 1
    with pytest.raises(TurnedAwayError, match="close one of them") as refused:
        known.begin("one more", 1)
    assert refused.value.status == 503 and len(known) == PAGE_SESSIONS_MAX


def test_wrong_passwords_make_the_next_try_wait_longer_and_a_right_one_ends_that(clock: Clock) -> None:
    known = Sessions({})
    waits = []
    for _ in range(12):
        known.note_try("anna", right=False)
        waits.append(known.wait_s("anna"))
        clock.now_s += waits[-1]
    assert waits[:5] == [0, 0, 1, 2, 4] and waits[-1] == 60
    assert known.wait_s("ben") == 0
    known.note_try("anna", right=True)
    assert known.wait_s("anna") == 0


def test_a_name_that_there_is_not_is_as_wrong_as_a_password() -> None:
    assert not Sessions({}).is_right("nobody", "") and not Sessions({}).is_right("nobody", "x")


def test_a_rate_lets_some_through_at_once_and_then_some_a_second(clock: Clock) -> None:
    limit = Rate(a_second=10, at_once=3)
    assert [limit.wait_s() for _ in range(3)] == [0, 0, 0]
    assert limit.wait_s() == pytest.approx(0.1)
    clock.now_s += 0.1
    assert limit.wait_s() == 0 and limit.wait_s() > 0
    clock.now_s += 60
    assert [limit.wait_s() > 0 for _ in range(4)] == [False, False, False, True]
