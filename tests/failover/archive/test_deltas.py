"""Copies that are deltas to the copy before: what follows what, what is fetched, what is kept, and when a base is put again."""

from __future__ import annotations

import random
import tempfile
import time
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from checkpoint.model import Snapshot
from checkpoint.snapshot import format
from failover.archive import archive as archives
from failover.archive.archive import Archive, Last
from failover.archive.keys import Keys, keys_without_members
from failover.archive.objects import FolderObjects
from failover.archive.witness import WitnessObjects
from failover.core.types import SPAN
from failover.errors import ArchiveError
from tests import witnesses
from tests.checkpoint.snapshots import COMPONENT, PAGE, pages_of, snapshot

pytest.importorskip("cryptography")

KEYS = keys_without_members(bytes(range(32)))
PAGES = 100


class Member:
    """One member's process: what it remembers, and the states that it has put."""

    def __init__(self, place: Path, keys: Keys = KEYS) -> None:
        self.place = place
        place.mkdir(exist_ok=True)
        self.last: dict[str, Last] = {}
        self.archive = Archive(FolderObjects(place), keys, "lab", place.parent, last=self.last)
        self.some = random.Random(1)
        self.state = {number: self.some.randbytes(PAGE) for number in range(PAGES)}
        self.made: list[Snapshot] = []

    def put(self, changed: int = 1, epoch: int = 1) -> str:
        for number in self.some.sample(range(PAGES), changed):
            self.state[number] = self.some.randbytes(PAGE)
        self.made.append(replace(snapshot(self.state, sequence=len(self.made) + 1), epoch=epoch))
        return self.put_again()

    def put_again(self) -> str:
        with tempfile.TemporaryFile() as file:
            format.encode(self.made[-1], file)
            file.flush()
            return self.archive.put(file, "robot1")[0]

    def fetched(self, number: int = 0) -> Snapshot:
        with tempfile.TemporaryFile() as file:
            self.archive.fetch(self.archive.copies(COMPONENT)[number], file)
            return format.decode(file.fileno())


@pytest.fixture
def member(tmp_path: Path) -> Member:
    return Member(tmp_path / "place")


def is_delta(name: str) -> bool:
    assert (".delta~" in name) != (".base." in name)
    return ".delta~" in name


def test_what_has_changed_travels_alone_and_each_copy_comes_back_whole(member: Member) -> None:
    names = [member.put() for _ in range(5)]
    assert [is_delta(name) for name in names] == [False, True, True, True, True]
    sizes = [(member.place / name).stat().st_size for name in names]
    assert sizes[0] > PAGES * PAGE and max(sizes[1:]) < 4 * PAGE
    copies = member.archive.copies(COMPONENT)
    assert [copy.name for copy in copies] == names[::-1] and copies[0].before == tuple(names[:4]) and copies[0].size == sum(sizes)
    for number, state in enumerate(reversed(member.made)):
        assert pages_of(member.fetched(number)) == pages_of(state) and member.fetched(number).position == state.position


def test_after_some_deltas_and_after_large_ones_a_base_is_put(member: Member, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archives, "DELTAS_MAX", 3)
    assert [is_delta(member.put()) for _ in range(6)] == [False, True, True, True, False, True]
    assert [is_delta(member.put(changed=20)) for _ in range(2)] == [True, True]
    assert not is_delta(member.put(changed=60)), "half of the base"
    monkeypatch.setattr(archives, "DELTAS_MAX", 15)
    assert [is_delta(member.put(changed=14)) for _ in range(4)] == [True, True, True, False], "half of it together"
    assert is_delta(member.put()) and pages_of(member.fetched()) == pages_of(member.made[-1])
    monkeypatch.setattr(archives, "CHANGED_MAX", 9 * PAGE)
    assert is_delta(member.put(changed=9)) and not is_delta(member.put(changed=10))


def test_another_process_another_epoch_and_other_readers_begin_with_a_base(member: Member) -> None:
    member.put()
    assert is_delta(member.put())
    member.last.clear()
    assert not is_delta(member.put()) and is_delta(member.put())
    assert not is_delta(member.put(epoch=2))
    member.archive._keys = replace(KEYS, readers=(*KEYS.readers, bytes(range(1, 33))))
    assert not is_delta(member.put()) and is_delta(member.put())


def test_where_another_member_has_put_meanwhile_or_the_chain_was_harmed_a_base_is_put(member: Member) -> None:
    other = Member(member.place)
    base = member.put()
    other.made = list(member.made)
    assert is_delta(member.put())
    other.made.append(member.made[-1])
    assert not is_delta(other.put()) and pages_of(member.fetched()) == pages_of(other.made[-1])
    member.made = list(other.made)
    last = member.put()
    assert not is_delta(last) and is_delta(member.put())
    path = member.place / last
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    assert not is_delta(member.put()), "the base before it does not prove itself"
    assert (member.place / base).exists()


def test_what_a_site_that_was_given_up_puts_late_is_not_the_newest(member: Member) -> None:
    """An operator recovered it at another site, in the first epoch of the next span; the lost one ran on behind a cut."""
    here = member.put(epoch=SPAN)
    lost = Member(member.place)
    late = lost.put(epoch=3)
    assert late > here and [copy.name for copy in member.archive.copies(COMPONENT)] == [here, late]
    member.put(epoch=SPAN)
    member.archive.thin(COMPONENT, 1)
    assert late not in [copy.name for copy in member.archive.copies(COMPONENT)]


@pytest.mark.parametrize("harm", ["a byte", "cut off", "gone"])
def test_whatever_object_of_the_chain_is_harmed_the_next_copy_is_a_base(harm: str, member: Member) -> None:
    names = [member.put() for _ in range(4)]
    path = member.place / names[2]
    match harm:
        case "a byte":
            path.write_bytes(path.read_bytes()[:-1] + b"x")
        case "cut off":
            path.write_bytes(b"")
        case "gone":
            path.unlink()
    again = member.put_again()
    assert again != names[3] and not is_delta(again) and pages_of(member.fetched()) == pages_of(member.made[-1])
    assert is_delta(member.put())


def test_what_follows_an_object_that_is_gone_stands_in_no_later_copys_way(
    member: Member, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        now_s = time.time()
        patch.setattr(archives.time, "time", lambda: now_s + 86_400)
        names = [member.put() for _ in range(3)]
    (member.place / names[0]).unlink()
    assert member.archive.copies(COMPONENT) == []
    later = [member.put() for _ in range(3)]
    assert sorted(names + later) == names + later and [is_delta(name) for name in later] == [False, True, True]
    assert [copy.name for copy in member.archive.copies(COMPONENT)] == later[::-1]
    assert member.archive.thin(COMPONENT, 1) == 2


def test_a_delta_whose_parent_another_member_removes_meanwhile_gives_way_to_a_base(
    member: Member, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = member.put()
    real = archives.sealed.seal

    def seal_while_it_goes(*arguments: Any) -> int:
        monkeypatch.setattr(archives.sealed, "seal", real)
        (member.place / base).unlink()
        return real(*arguments)

    monkeypatch.setattr(archives.sealed, "seal", seal_while_it_goes)
    name = member.put()
    assert not is_delta(name) and [copy.name for copy in member.archive.copies(COMPONENT)] == [name]


def test_names_of_a_hostile_place_cost_little_and_lead_nowhere(member: Member) -> None:
    base = member.put()
    folder, _, file = (member.place / base).name.partition("-")
    numbers = file.split("-")
    for at in range(1, 40):
        following = (
            f"{int(folder, 16) + at:012x}-{numbers[0]}-{numbers[1]}-{at + 1:016x}-00.delta~{int(folder, 16) + at - 1:012x}.sealed"
        )
        (member.place / base).with_name(following).touch()
    (member.place / base).with_name(f"{int(folder, 16) + 99:012x}-{'f' * 40}-1-1-00.base.sealed").touch()
    copies = member.archive.copies()
    assert len(copies) == 1 + archives.DELTAS_MAX and max(len(copy.before) for copy in copies) == archives.DELTAS_MAX


def test_where_a_witness_has_no_room_what_the_newest_copy_needs_stays(tmp_path: Path) -> None:
    with witnesses.keeping(tmp_path / "gate", KEYS.shared, size_max=int(2.2 * PAGES * PAGE)) as gate:
        member = Member(tmp_path / "place")
        member.archive = Archive(WitnessObjects(gate, KEYS.shared), KEYS, "lab", tmp_path, last=member.last)
        older = member.put()
        member.last.clear()
        names = [member.put() for _ in range(3)]
        member.state |= {number: member.some.randbytes(PAGE) for number in range(PAGES, 128)}
        member.last.clear()
        with pytest.raises(ArchiveError, match="no room for"):
            member.put()
        assert [copy.name for copy in member.archive.copies()] == [*names[::-1], older], "nothing goes where it would not suffice"
        member.made.pop()
        member.state = {number: member.state[number] for number in range(PAGES)}
        newest = member.put(changed=90)
        assert not is_delta(newest) and [copy.name for copy in member.archive.copies()] == [newest, *names[::-1]]
        assert pages_of(member.fetched()) == pages_of(member.made[-1]) and pages_of(member.fetched(1)) != pages_of(
            member.made[-1]
        )


def test_a_copy_that_was_harmed_is_put_again_as_a_base(member: Member) -> None:
    member.put()
    name = member.put()
    assert member.put_again() == name
    path = member.place / name
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    again = member.put_again()
    assert again > name and not is_delta(again) and pages_of(member.fetched()) == pages_of(member.made[-1])


def test_what_a_kept_copy_needs_is_kept_and_the_rest_goes(member: Member, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archives, "DELTAS_MAX", 3)
    names = [member.put() for _ in range(7)]
    assert member.archive.thin(COMPONENT, 2) == 0, "two bases: that of the newest, and one more"
    assert member.archive.thin(COMPONENT, 1) == 4, "the chain before the last base"
    assert [copy.name for copy in member.archive.copies(COMPONENT)] == names[:3:-1]
    names += [member.put() for _ in range(2)]
    assert [is_delta(name) for name in names[4:]] == [False, True, True, True, False]
    assert member.archive.thin(COMPONENT, 2) == 0, "the older of the two needs its whole chain"
    assert len(member.archive.copies(COMPONENT)) == 5
    assert pages_of(member.fetched(1)) == pages_of(member.made[-2])
    (member.place / names[4]).unlink()
    assert [copy.name for copy in member.archive.copies(COMPONENT)] == names[-1:], "deltas to what has gone are no copies"
    assert member.archive.thin(COMPONENT, 2) == 3 and [one.name for one in (member.place / names[0]).parent.iterdir()] == [
        Path(names[-1]).name
    ]


def test_when_copies_go_a_delta_goes_before_what_it_follows(member: Member, monkeypatch: pytest.MonkeyPatch) -> None:
    names = [member.put() for _ in range(3)]
    member.last.clear()
    names.append(member.put())
    gone: list[str] = []
    real = FolderObjects.remove
    monkeypatch.setattr(FolderObjects, "remove", lambda place, name: (gone.append(name), real(place, name)))
    member.archive.thin(COMPONENT, 1)
    assert gone == names[2::-1], "so that a thinning that breaks off leaves whole copies"


def test_a_delta_between_that_was_altered_exchanged_or_put_under_another_name_leads_nowhere(member: Member) -> None:
    names = [member.put() for _ in range(4)]
    path = member.place / names[2]
    whole = path.read_bytes()
    for content in (whole[:-1] + b"x", whole[:-40], (member.place / names[1]).read_bytes()):
        path.write_bytes(content)
        with pytest.raises(ArchiveError, match="was altered, "):
            member.fetched()
    path.unlink()
    assert [copy.name for copy in member.archive.copies(COMPONENT)] == names[1::-1]
    stamp = names[1].rpartition("~")[2]
    (member.place / names[3]).rename(member.place / (names[3].rpartition("~")[0] + "~" + stamp))
    assert len(member.archive.copies(COMPONENT)) == 3
    with pytest.raises(ArchiveError, match="put under another name"):
        member.fetched()


def test_one_who_holds_the_keys_and_names_another_copy_as_the_one_before_is_refused(member: Member) -> None:
    names = [member.put() for _ in range(3)]
    with tempfile.TemporaryFile() as delta:
        member.archive._fetch_one(names[2], names[2].split("/")[1], archives._file_of(names[2]), delta)
        forged = names[2].rpartition("~")[0] + "~" + names[0].split("/")[2].partition("-")[0] + ".sealed"
        content = archives._joined(_label_of(member, names[2]), delta)
        member.archive._kept(forged, content, 1 << 20)
    (member.place / names[2]).unlink()
    with pytest.raises(ArchiveError, match="does not continue the copy before it"):
        member.fetched()


def _label_of(member: Member, name: str) -> bytes:
    from failover.archive import sealed

    with (member.place / name).open("rb") as file:
        first = next(sealed.unsealed(KEYS, name, file))
    return first[: 4 + int.from_bytes(first[:4], "little")]


@pytest.mark.parametrize(
    "name",
    [
        "{0}-{1}.delta.sealed",
        "{0}-{1}.delta~.sealed",
        "{0}-{1}.delta~{0}.sealed",
        "{0}-{1}.delta~zz.sealed",
        "{0}-{1}.base~000000000001.sealed",
        "{0}-{1}.sealed",
        "-{1}.base.sealed",
    ],
)
def test_names_that_are_none_are_passed_over(name: str, member: Member) -> None:
    base = member.put()
    stamp, _, rest = base.rpartition("/")[2].partition("-")
    (member.place / base).with_name(name.format(f"{int(stamp, 16) + 5:012x}", rest.removesuffix(".base.sealed"))).write_bytes(
        b"x"
    )
    assert [copy.name for copy in member.archive.copies()] == [base]
