"""The page of machines holds the results of the kept runs."""

from __future__ import annotations

from tests.machines import seen


def test_the_page_holds_exactly_these_tables() -> None:
    assert seen.PAGE.read_text() == seen.written(), "run python -m tests.machines.seen"


def test_a_test_that_failed_or_was_skipped_on_one_machine_is_told_with_its_reason() -> None:
    facts = {"processor": "p", "kernel": "6.1.0", "tracking": "digest", "page_size": "4096", "on": "2026-01-01"}
    one = seen.Seen(**facts, results={"m::test_a_thing[x]": seen.PASSED, "m::test_a_thing[y]": "needs dc"})
    other = seen.Seen(**facts | {"kernel": "6.2.0"}, results={"m::test_a_thing[x]": "failed", "m::test_a_thing[y]": seen.PASSED})
    table = seen.table([one, other])
    assert "| A thing | 1 of 2 | 1 of 2, **1 failed** |" in table
    assert "| needs dc | y (A thing) | A |" in table
