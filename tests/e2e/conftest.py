"""Key pairs for every team of robots: each costs an interpreter, so they are made once and reused in each test."""

from __future__ import annotations

import itertools

import pytest

from failover.cli import key_pairs

Pair = tuple[str, str]


@pytest.fixture(scope="session")
def pairs_made() -> list[Pair]:
    """The real key pairs that there are so far."""
    return []


@pytest.fixture(autouse=True)
def _pairs_from_the_drawer(pairs_made: list[Pair], monkeypatch: pytest.MonkeyPatch) -> None:
    """No two robots of a test get the same pair; those of the next test get them again."""
    new_pair, numbers = key_pairs.new_pair, itertools.count()

    def pair() -> Pair:
        number = next(numbers)
        while len(pairs_made) <= number:
            pairs_made.append(new_pair())
        return pairs_made[number]

    monkeypatch.setattr(key_pairs, "new_pair", pair)
