"""Passwords: each guess is counted before it is checked, wrong ones become slow, and none keeps another place out."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any

import pytest

from failover.config.page import UserConfig, hashed, is_password
from page import passwords
from page.errors import TurnedAwayError
from page.limits import GUESSES_AT_ONCE
from page.passwords import DELAY_MAX_S, FORGOTTEN_S, FREE_TRIES, Passwords

HOME, ELSEWHERE = "192.0.2.1", "192.0.2.2"


class Clock:
    """The seconds that pass are the test's."""

    now_s = 1000.0


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    found = Clock()
    monkeypatch.setattr(passwords.time, "monotonic", lambda: found.now_s)
    return found


@pytest.fixture(scope="module")
def users() -> dict[str, UserConfig]:
    return {"anna": UserConfig(hashed("swordfish"))}


def status(tried: Coroutine[Any, Any, None]) -> int:
    """What became of a try: a status of HTTP."""
    try:
        asyncio.run(tried)
    except TurnedAwayError as error:
        return error.status
    return 200


def test_a_password_is_kept_as_a_digest_with_a_salt_of_its_own() -> None:
    one, other = hashed("swordfish"), hashed("swordfish")
    assert one != other and "swordfish" not in one
    assert is_password("swordfish", one) and is_password("swordfish", other)
    assert not is_password("swordfisch", one) and not is_password("", one)
    assert not is_password("x", "scrypt:16384:8:1:!!!!") and not is_password("x", "")


def test_a_line_that_would_take_all_memory_is_no_password() -> None:
    assert not is_password("x", f"scrypt:4194304:99:1:{'A' * 24}:{'A' * 44}")


def test_wrong_passwords_make_the_next_try_wait_longer_and_a_right_login_ends_that(users: Any, clock: Clock) -> None:
    known = Passwords(users)
    tried = lambda password, place=HOME, forgives=True: status(known.check("anna", password, place, forgives=forgives))  # noqa: E731
    assert [tried("x") for _ in range(FREE_TRIES + 1)] == [403] * FREE_TRIES + [429]
    assert tried("swordfish") == 429, "also the right one waits"
    assert tried("swordfish", ELSEWHERE, False) == 200, "and not that from another place, as Prometheus'"
    for delay_s in (1, 2, 4, 8, 16, 32, 60, 60):
        clock.now_s += delay_s - 0.1
        assert tried("x") == 429, delay_s
        clock.now_s += 0.1
        assert tried("x") == 403, delay_s
    clock.now_s += 60
    assert tried("swordfish", HOME, False) == 200, "a right one that does not forgive counts for nothing"
    assert tried("x") == 403 and tried("x") == 429
    clock.now_s += 60
    assert tried("swordfish") == 200
    assert [tried("x") for _ in range(FREE_TRIES + 1)] == [403] * FREE_TRIES + [429]


def test_tries_beyond_all_powers_of_two_still_wait_for_a_minute(users: Any, clock: Clock) -> None:
    known = Passwords(users)
    known._wrong["anna", HOME] = 5_000, clock.now_s
    assert known._wait_s(("anna", HOME)) == DELAY_MAX_S
    clock.now_s += FORGOTTEN_S + 1
    assert status(known.check("anna", "x", HOME, forgives=True)) == 403
    assert known._wrong["anna", HOME][0] == 1


def test_guesses_at_the_same_time_are_one_guess(users: Any) -> None:
    async def run() -> list[Any]:
        known = Passwords(users)
        guesses = [known.check("anna", f"guess {number}", HOME, forgives=True) for number in range(50)]
        found = await asyncio.gather(*guesses, return_exceptions=True)
        assert known._wrong["anna", HOME][0] == 1
        return found

    assert sorted(error.status for error in asyncio.run(run())) == [403] + [429] * 49


def test_so_many_wait_to_be_checked_and_all_names_that_there_are_not_are_one(users: Any) -> None:
    async def run() -> list[Any]:
        known = Passwords(users)
        guesses = [known.check(f"name{number}", "x", HOME, forgives=True) for number in range(10)]
        guesses += [known.check("ben", "x", f"192.0.2.{number}", forgives=True) for number in range(10, 40)]
        found = await asyncio.gather(*guesses, return_exceptions=True)
        assert len(known._wrong) == GUESSES_AT_ONCE
        return found

    assert sorted(error.status for error in asyncio.run(run())) == [403] * GUESSES_AT_ONCE + [429] * (40 - GUESSES_AT_ONCE)


def test_a_name_that_there_is_not_is_as_wrong_as_a_password() -> None:
    assert not Passwords({}).is_right("nobody", "") and not Passwords({}).is_right("nobody", "x")
