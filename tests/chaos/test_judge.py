"""The judge of the campaigns finds what must never happen: each test breaks one promise."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.chaos import actuator
from tests.chaos.actuator import Command, Record, Safe
from tests.chaos.judge import BrokenPromiseError, Judge

MS = 1_000_000
PAUSE_MS = 250
PERIOD_MS = 50


class Story:
    """Commands of copies of one program, one every `PERIOD_MS`."""

    def __init__(self) -> None:
        self.judge = Judge(["lamp"], PAUSE_MS)
        self.at_ns = 0
        self.seals = {0: 0}

    def act(self, copy: str, first: int, last: int, epoch: int = 1, dice: int = 0) -> None:
        """A copy commands these steps."""
        for step in range(first, last + 1):
            self.at_ns += PERIOD_MS * MS
            before, self.seals[step] = self.seals[step - 1], step * 1000 + dice
            self.judge.hear([Command(self.at_ns, copy, "lamp", step, before, self.seals[step], epoch, "net:[1]")])

    def safe(self, step: int) -> None:
        """The program is told so."""
        self.judge.hear([Safe(self.at_ns, "lamp", step, self.seals[step])])


@pytest.fixture
def story() -> Story:
    """Twenty steps at one robot, eighteen of them acknowledged."""
    told = Story()
    told.act("one", 1, 20)
    told.safe(18)
    return told


def test_a_takeover_that_loses_nothing_is_no_crime_and_is_a_pause(story: Story) -> None:
    story.at_ns += 700 * MS
    story.act("two", 19, 30, epoch=2, dice=7)
    story.safe(25)
    assert story.judge.histories["lamp"].stands_on(18, 18_000)
    (pause,) = story.judge.pauses()
    assert (pause.length_ms, pause.moved, pause.lost) == (750, True, 2)


def test_a_copy_that_acts_after_another_one_has_begun_is_a_crime(story: Story) -> None:
    story.act("two", 19, 22, epoch=2)
    with pytest.raises(BrokenPromiseError, match="two copies act at once"):
        story.act("one", 21, 21)


def test_an_older_epoch_is_a_crime_whichever_copy_it_is(story: Story) -> None:
    story.act("two", 21, 22, epoch=3)
    with pytest.raises(BrokenPromiseError, match="an older epoch acts"):
        story.act("three", 23, 23, epoch=2)


def test_a_copy_that_begins_before_what_was_acknowledged_is_a_crime(story: Story) -> None:
    with pytest.raises(BrokenPromiseError, match="step 18 was acknowledged"):
        story.act("two", 18, 18, epoch=2)


def test_a_copy_from_another_history_is_a_crime_though_its_number_is_high_enough(story: Story) -> None:
    story.seals[18] = 4711
    with pytest.raises(BrokenPromiseError, match="is not in the past"):
        story.act("two", 19, 19, epoch=2)


def test_a_copy_that_leaves_a_step_out_is_a_crime(story: Story) -> None:
    story.seals[21] = 21_000
    with pytest.raises(BrokenPromiseError, match="one copy goes from step 20 to 22"):
        story.act("one", 22, 22)


def test_a_line_that_is_still_being_written_waits_for_its_rest(tmp_path: Path) -> None:
    path = tmp_path / actuator.RECORD
    path.write_text("5 31 lamp 1 0 99 2 net:[7]\n6 31 lamp safe 1")
    record = Record(path)
    assert list(record.fresh()) == [Command(5, "31 net:[7]", "lamp", 1, 0, 99, 2, "net:[7]")]
    with path.open("a") as file:
        file.write(" 99\n")
    assert list(record.fresh()) == [Safe(6, "lamp", 1, 99)]
    record.close()
