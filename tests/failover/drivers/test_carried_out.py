"""The file in which a driver without kept state notes what it has carried out: cut, grown, damaged, without room."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from failover.core.messaging.envelope import Envelope, answer
from failover.core.messaging.mailbox import NO_ANSWER, Mailbox
from failover.drivers import carried_out
from failover.drivers.carried_out import ANSWER_SIZE_MAX, CarriedOut

PATH = "Lab/Lamp"


def message(seq: int, sender: str = "robot1/a", boot: int = 7, **fields: Any) -> Envelope:
    return Envelope(verb="set", sender=sender, boot=boot, seq=seq, id=f"{sender}-{seq}", reliable=True, **fields)


class Life:
    """One process of the driver: its mailbox, and the file that it has found."""

    def __init__(self, place: Path) -> None:
        self.file = CarriedOut(place, PATH)
        self.mailbox = Mailbox(self.file.streams)

    def asked(self, one: Envelope, now_ns: int = 1) -> list[Envelope]:
        """What is answered to a message at once, because it came before; [] of one that is to be carried out."""
        return self.mailbox.arrived(one, now_ns)

    def begin(self) -> Envelope:
        one = self.mailbox.take(1)
        assert one is not None
        self.file.began([one])
        return one

    def end(self, one: Envelope, result: Any) -> None:
        self.mailbox.done(one, answer(one, result))
        self.file.over(self.mailbox.committed(), self.mailbox.kept)

    def carry_out(self, one: Envelope, result: Any = None) -> None:
        assert self.asked(one) == []
        self.end(self.begin(), result)


@pytest.fixture
def place(tmp_path: Path) -> Path:
    return tmp_path / "Lab.Lamp.done"


def test_a_later_process_gives_the_answers_of_the_one_before_and_carries_out_what_that_has_not(place: Path) -> None:
    first = Life(place)
    first.carry_out(message(1), "one")
    first.carry_out(message(2), "two")
    for _ in range(2):
        later = Life(place)
        assert [one.ok for one in later.asked(message(1)) + later.asked(message(2))] == ["one", "two"]
    later.carry_out(message(3), "three")
    assert Life(place).asked(message(3))[0].ok == "three"


def test_a_command_that_was_in_hand_is_not_begun_again_and_its_sender_is_told(place: Path) -> None:
    first = Life(place)
    assert first.asked(message(1)) == first.asked(message(2)) == []
    first.begin()
    for _ in range(2):
        later = Life(place)
        (told,) = later.asked(message(1))
        assert told.error.kind == NO_ANSWER  # type: ignore[union-attr]
        assert "Lab/Lamp ended while it carried out set; it may have been carried out" in told.error.sentence  # type: ignore[union-attr]
        assert later.asked(message(2)) == [], "which was not begun"


def test_at_whatever_byte_the_process_was_killed_what_was_whole_counts(place: Path) -> None:
    first = Life(place)
    first.carry_out(message(1), "one")
    whole = place.stat().st_size
    first.carry_out(message(2), "two")
    content = place.read_bytes()
    for size in range(whole, len(content)):
        place.write_bytes(content[:size])
        later = Life(place)
        assert later.asked(message(1))[0].ok == "one"
        assert [one.ok for one in later.asked(message(2)) if one.error is not None and one.ok] == []
        later.mailbox.arrived(message(3), 1)
        later.carry_out(message(4), "four") if later.mailbox.first() is None else later.end(later.begin(), "next")
        assert Life(place).file.streams["robot1/a"].last >= 1, "what is written behind it is read"


def test_an_answer_that_is_too_large_is_not_kept_and_its_sender_is_told_to_ask_again(place: Path) -> None:
    Life(place).carry_out(message(1), "x" * ANSWER_SIZE_MAX)
    (told,) = Life(place).asked(message(1))
    assert told.error.kind == NO_ANSWER and "ask again" in told.error.sentence  # type: ignore[union-attr]
    assert place.stat().st_size < ANSWER_SIZE_MAX


def test_the_file_stays_small_and_still_knows_each_sender(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(carried_out, "TIDY_SIZE", 4_000)
    life = Life(place)
    for seq in range(1, 500):
        for sender in ("robot1/a", "robot1/b"):
            life.carry_out(message(seq, sender, had=seq - 1), seq)
    assert place.stat().st_size < 5_000
    later = Life(place)
    for sender in ("robot1/a", "robot1/b"):
        assert later.asked(message(499, sender))[0].ok == 499
        assert later.asked(message(3, sender)) == [] and later.mailbox.first() is None, "it has had its answer"


def test_a_later_life_of_a_sender_begins_anew(place: Path) -> None:
    first = Life(place)
    first.carry_out(message(5), "old")
    first.carry_out(message(1, boot=8), "new")
    later = Life(place)
    assert later.asked(message(1, boot=8))[0].ok == "new" and later.mailbox.boot_of("robot1/a") == 8


@pytest.mark.parametrize("content", [b"", b"\0" * 100, os.urandom(1000)])
def test_a_file_that_is_none_is_as_if_the_robot_had_booted(place: Path, content: bytes) -> None:
    place.write_bytes(content)
    Life(place).carry_out(message(1), "one")
    assert Life(place).asked(message(1))[0].ok == "one"


def test_records_of_another_version_are_forgotten_with_a_warning(place: Path, caplog: pytest.LogCaptureFixture) -> None:
    from failover.drivers.posts_file import framed

    Life(place).carry_out(message(1), "one")
    place.write_bytes(place.read_bytes() + framed(b"\x81\xa4type\xa5other", 0))
    assert Life(place).asked(message(1)) == [] and "is forgotten" in caplog.text


def test_without_room_the_driver_goes_on(tmp_path: Path) -> None:
    life = Life(tmp_path / "none" / "Lab.Lamp.done")
    life.carry_out(message(1), "one")
    assert life.asked(message(1))[0].ok == "one"
