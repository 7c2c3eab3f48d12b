"""The file in which a driver without kept state notes what it has carried out: cut, grown, damaged, without room."""

from __future__ import annotations

import contextlib
import os
import resource
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from failover.core.messaging.envelope import Envelope, answer
from failover.core.messaging.mailbox import NO_ANSWER, Mailbox
from failover.drivers import carried_out
from failover.drivers.carried_out import ANSWER_LOST, ANSWER_SIZE_MAX, CarriedOut

PATH = "Lab/Lamp"


def message(seq: int, sender: str = "robot1/a", boot: int = 7, **fields: Any) -> Envelope:
    return Envelope(verb="set", sender=sender, boot=boot, seq=seq, id=f"{sender}-{seq}", reliable=True, **fields)


class Life:
    """One process of the driver: its mailbox, and the file that it has found."""

    def __init__(self, place: Path) -> None:
        self.file = CarriedOut(place, PATH)
        self.mailbox = Mailbox(self.file.streams, self.file.asked)

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

    def ask(self, one: Envelope, result: Any = None) -> None:
        """A query."""
        assert self.asked(one) == []
        taken = self.mailbox.take(1)
        assert taken is not None
        self.end(taken, result)

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


def test_of_a_command_with_a_large_answer_its_sender_is_told_that_it_was_carried_out(place: Path) -> None:
    Life(place).carry_out(message(1), "x" * ANSWER_SIZE_MAX)
    for _ in range(2):
        (told,) = Life(place).asked(message(1))
        assert told.error.kind == ANSWER_LOST and "Lab/Lamp has carried it out" in told.error.sentence  # type: ignore[union-attr]
    assert place.stat().st_size < ANSWER_SIZE_MAX


def test_a_query_with_a_large_answer_is_asked_again_though_later_messages_were_answered(place: Path) -> None:
    first = Life(place)
    first.ask(message(1), "x" * ANSWER_SIZE_MAX)
    first.ask(message(2), "small")
    for _ in range(2):
        later = Life(place)
        assert [one.ok for one in later.asked(message(2))] == ["small"]
    later.ask(message(1), "y" * ANSWER_SIZE_MAX)
    assert [one.ok for one in later.asked(message(2)) + later.asked(message(1))] == ["small", "y" * ANSWER_SIZE_MAX]
    assert later.asked(message(2, had=2)) != [] and Life(place).asked(message(1)) == [] and place.stat().st_size < ANSWER_SIZE_MAX
    first = Life(place)
    first.ask(message(1), "now small")
    assert [one.ok for one in Life(place).asked(message(1))] == ["now small"]


def test_answers_of_many_senders_do_not_make_the_file_large(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(carried_out, "ANSWERS_SIZE_MAX", 10_000)
    monkeypatch.setattr(carried_out, "TIDY_SIZE", 4_000)
    life = Life(place)
    for number in range(50):
        (life.ask if number % 2 else life.carry_out)(message(1, f"robot1/{number}"), "x" * 3_000)
    Life(place)
    assert place.stat().st_size < 30_000
    later = Life(place)
    assert [later.asked(message(1, f"robot1/{number}"))[0].ok for number in (48, 49)] == ["x" * 3_000] * 2
    assert {later.asked(message(1, f"robot1/{number}"))[0].error.kind for number in (0, 1)} == {ANSWER_LOST}  # type: ignore[union-attr]


@contextlib.contextmanager
def full_at(size: int) -> Iterator[None]:
    """The kernel writes no file any further than this: the write that reaches it is cut."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("cut", [0, 1, 25, 60])
def test_a_write_that_was_cut_short_hides_nothing_that_is_written_later(
    place: Path, cut: int, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(carried_out, "RETRY_S", 0.0)
    life = Life(place)
    life.carry_out(message(1), "one")
    with full_at(place.stat().st_size + cut):
        for seq in range(2, 6):
            life.carry_out(message(seq), seq)
        copy = place.read_bytes()
    assert caplog.text.count("a command may come twice") == 1
    for seq in range(6, 9):
        life.carry_out(message(seq), seq)
    later = Life(place)
    assert [later.asked(message(seq))[0].ok for seq in range(1, 9)] == ["one", *range(2, 9)]
    assert not list(place.parent.glob("*.new"))
    place.write_bytes(copy)
    assert Life(place).asked(message(1))[0].ok == "one", "killed while it was full"


def test_without_room_to_write_anew_half_a_record_is_cut_off_before_the_next_one(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Life(place).carry_out(message(1), "one")
    place.write_bytes(place.read_bytes() + b"half")
    with monkeypatch.context() as patched:
        patched.setattr(Path, "rename", lambda *_: os.open("/dev/full/none", os.O_RDONLY))
        life = Life(place)
    life.file._again_s = float("inf")
    life.carry_out(message(2), "two")
    later = Life(place)
    assert [later.asked(message(seq))[0].ok for seq in (1, 2)] == ["one", "two"]


def test_a_command_of_which_only_the_beginning_was_noted_moves_nothing_back(place: Path) -> None:
    first = Life(place)
    first.file.began([message(1)])  # and its answer found no room
    for seq in range(2, 5):
        first.file.began([message(seq)])
        first.file.over([answer(message(seq), seq)], dict)
    for _ in range(2):
        later = Life(place)
        stream = later.file.streams["robot1/a"]
        assert (stream.last, list(stream.answers)) == (4, [1, 2, 3, 4])
        assert [later.asked(message(seq))[0].ok for seq in range(2, 5)] == [2, 3, 4]
        assert later.asked(message(1))[0].error.kind == NO_ANSWER  # type: ignore[union-attr]
    later.carry_out(message(5, had=3), 5)
    assert list(later.mailbox.kept()["robot1/a"].answers) == [4, 5]


def test_what_is_left_of_an_earlier_life_of_a_sender_changes_nothing(place: Path) -> None:
    first = Life(place)
    first.file.began([message(9)])
    first.file.over([answer(message(1, boot=8), "new")], dict)
    stream = Life(place).file.streams["robot1/a"]
    assert (stream.boot, stream.last, list(stream.answers)) == (8, 1, [1])


def test_only_its_user_reads_the_file(place: Path) -> None:
    before = os.umask(0o022)
    try:
        Life(place).carry_out(message(1), "one")
    finally:
        os.umask(before)
    assert stat.S_IMODE(place.stat().st_mode) == 0o600


def test_a_file_that_cannot_be_read_is_told_and_the_driver_begins(place: Path, caplog: pytest.LogCaptureFixture) -> None:
    place.mkdir()
    life = Life(place)
    life.carry_out(message(1), "one")
    assert "cannot be read: Is a directory" in caplog.text and life.asked(message(1))[0].ok == "one"


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
