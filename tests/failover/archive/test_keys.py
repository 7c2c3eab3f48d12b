"""Who opens a sealed copy: with real keys of members, as `failover team` makes them."""

from __future__ import annotations

import io
import os
import shutil
from pathlib import Path

import pytest
from blake3 import blake3
from msgspec.structs import replace

from agent.worker.network.replication_link import new_keys
from failover.archive import keys, sealed
from failover.archive.archive import Archive
from failover.archive.objects import FolderObjects
from failover.config import team as team_directory
from failover.config.team import Robot, Role, Team
from failover.errors import ArchiveError, TeamFileError

pytest.importorskip("cryptography")

NAME = "lab/@x/1.base.sealed"
OBJECT_OF_AES = (
    "464f415243485632370373d3484117dc4129ee3b2c141900a611b6b95c47da83cfba0c007f3588e74c183aa822850eff7c71"
    "302c1539406f8879a7771595bdab33ee3b8ab882b90501002ce4bc1a02edaac3b2bb1cb3c180f18d66513d0f9264d6ea5dd5"
    "f1eb50a9c9d9b2d4297b86a980f43107e0275f1dc5e74b54a96b59b69c364b4c0e3665793f8351d8430b1cfab098ed7b1d68"
    "3f29ba2021f1"
)
OBJECT_OF_CHACHA = (
    "464f415243484332c1be4c09743e4911c6b3bc5d66f7057f62c59baf8bf392a60865b316aa3560e0879034ed7e4af3ff1a68"
    "d55a05deb0c1f7a62e6ff5cc7f4be2a6c3e3209f474d01002ce4bc1a02edaac384f16ad7a0e9871037d0844eb1871b492616"
    "de1333eed51eb422059e08da9b2c3191848a1c26ae914284594ecbec79663707ed9a6b5e3be2506d0755149ec8129efa2d87"
    "2392f7b155c0"
)
ROLES: dict[str, Role] = {"robot1": "robot", "robot2": "robot", "store": "server", "gate": "witness"}


class Members:
    """The team directories of a team, each with the secret key of its own member alone."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.recovery = directory / "safe"
        pairs = {name: new_keys() for name in ROLES}
        robots = {
            name: Robot((f"127.0.0.1:{7400 + place}",), f"127.0.0.1:{7500 + place}", role, pairs[name][0], place)
            for place, (name, role) in enumerate(ROLES.items())
        }
        self.team = Team("lab", robots, next_seat=len(robots))
        for name in ROLES:
            team_directory.write(self.of(name), self.team)
            team_directory.write_secret_key(self.of(name), name, pairs[name][1])
        first = keys.new_key(self.of("robot1"))
        shutil.move(keys.recovery_path(self.of("robot1")), self.recovery)
        for name in list(ROLES)[1:]:  # the witness as well: as if it had been stolen
            shutil.copy2(first, keys.key_path(self.of(name)))

    def of(self, name: str) -> Path:
        return self.directory / name

    def keys(self, name: str, team: Team | None = None) -> keys.Keys:
        return keys.read_keys(self.of(name), team or self.team)

    def without(self, gone: str) -> Team:
        return Team("lab", {name: one for name, one in self.team.robots.items() if name != gone}, next_seat=len(ROLES))


@pytest.fixture
def members(tmp_path: Path) -> Members:
    return Members(tmp_path)


def seal(by: keys.Keys, name: str = NAME) -> bytes:
    with io.BytesIO() as file:
        sealed.seal(by, name, iter([b"the memory"]), file)
        return file.getvalue()


def opened(content: bytes, by: keys.Keys, name: str = NAME) -> bytes:
    return b"".join(sealed.unsealed(by, name, io.BytesIO(content)))


def test_each_robot_and_server_opens_a_copy_by_its_own_key_and_a_witness_with_the_archive_key_does_not(members: Members) -> None:
    copy = seal(members.keys("robot1"))
    assert [opened(copy, members.keys(name)) for name in ("robot1", "robot2", "store")] == [b"the memory"] * 3
    with pytest.raises(ArchiveError, match=r"sealed with other keys than those .* bring archive\.recovery"):
        opened(copy, members.keys("gate"))


def test_a_member_that_was_taken_out_opens_what_was_sealed_before_and_nothing_later(members: Members) -> None:
    before, after = seal(members.keys("robot1")), seal(members.keys("robot1", members.without("robot2")))
    assert opened(before, members.keys("robot2")) == b"the memory"
    with pytest.raises(ArchiveError, match="sealed with other keys"):
        opened(after, members.keys("robot2"))
    assert opened(after, members.keys("store")) == b"the memory"


def test_the_recovery_key_opens_a_copy_when_no_key_of_a_member_is_left_and_needs_the_archive_key(members: Members) -> None:
    copy = seal(members.keys("robot1"))
    new = members.directory / "new machine"
    team_directory.write(new, members.without("robot1"))
    (new / "keys").mkdir(exist_ok=True)
    shutil.copy2(keys.key_path(members.of("robot1")), keys.key_path(new))
    with pytest.raises(ArchiveError, match="sealed with other keys"):
        opened(copy, keys.read_keys(new, members.team))
    shutil.copy2(members.recovery, keys.recovery_path(new))
    assert opened(copy, keys.read_keys(new, members.team)) == b"the memory"
    other = members.directory / "another team"
    team_directory.write(other, members.team)
    keys.new_key(other)
    shutil.copy2(members.recovery, keys.recovery_path(other))
    with pytest.raises(ArchiveError, match=r"recovery was made with another archive key than .*archive\.key: bring the two"):
        keys.read_keys(other, members.team)
    with pytest.raises(ArchiveError, match="sealed with another archive key"):
        opened(copy, replace(keys.read_keys(new, members.team), shared=keys.read_key(other)))


def test_both_keys_of_a_member_that_replaces_its_own_open_what_is_sealed_meanwhile(members: Members) -> None:
    public, secret = new_keys()
    replacing = {**members.team.robots, "robot2": Robot(("127.0.0.1:1",), "127.0.0.1:2", "robot", *_keys_of(members, public))}
    copy = seal(members.keys("robot1", Team("lab", replacing, next_seat=len(ROLES))))
    assert opened(copy, members.keys("robot2")) == b"the memory"
    team_directory.secret_key_path(members.of("robot2"), "robot2").write_text(secret + "\n")
    assert opened(copy, members.keys("robot2")) == b"the memory"


def _keys_of(members: Members, following: str) -> tuple[str, int, str]:
    before = members.team.robots["robot2"]
    return before.public_key, before.seat, following


def test_a_head_of_another_copy_and_one_for_other_readers_are_refused(members: Members) -> None:
    known = members.keys("robot1")
    one, other = seal(known), seal(known, "lab/@x/2.base.sealed")
    assert sealed.readers_in(sealed.read_head(NAME, io.BytesIO(one))) == keys.ids_of(known.readers) and len(known.readers) == 4
    size = sealed.HEAD_SIZE_LEAST + 4 * keys.WRAP_SIZE
    with pytest.raises(ArchiveError, match="its head is refused"):
        opened(other[:size] + one[size:], known)
    spliced = one[: sealed.WRAPS_AT] + other[sealed.WRAPS_AT : size] + one[size:]
    with pytest.raises(ArchiveError, match="its head is refused"):
        opened(spliced, known)


@pytest.mark.parametrize("change", ["one goes", "one is added", "one is exchanged"])
def test_of_a_copy_no_reader_can_be_taken_added_or_exchanged(change: str, members: Members) -> None:
    known = members.keys("robot1")
    copy = seal(known)
    own = keys.reader_id(keys._public_of(known.secrets[0]))
    head = sealed.read_head(NAME, io.BytesIO(copy))
    parts = [head[at : at + keys.WRAP_SIZE] for at in range(sealed.HEAD_SIZE_LEAST, len(head), keys.WRAP_SIZE)]
    other = next(at for at, part in enumerate(parts) if not part.startswith(own))
    wrap = os.urandom(keys.WRAP_SIZE)
    match change:
        case "one goes":
            del parts[other]
        case "one is added":
            parts.append(wrap)
        case "one is exchanged":
            parts[other] = wrap
    count = len(parts).to_bytes(keys.COUNT_SIZE, "little")
    begin = head[: sealed.HEAD_SIZE_LEAST - keys.COUNT_SIZE]
    with pytest.raises(ArchiveError, match="its frame 0 is refused"):
        opened(b"".join((begin, count, *parts, copy[len(head) :])), known)


def test_an_object_of_another_day_still_opens() -> None:
    """The bytes as ARCHIVE.md says them, sealed once with these keys: a change of the derivations is a change of the format."""
    known = keys.keys_without_members(bytes(range(32)))
    assert opened(bytes.fromhex(OBJECT_OF_AES), known) == opened(bytes.fromhex(OBJECT_OF_CHACHA), known) == b"the memory"


def test_who_could_not_open_what_it_seals_seals_nothing(members: Members, tmp_path: Path) -> None:
    secret = team_directory.secret_key_path(members.of("robot1"), "robot1")
    secret.write_text(new_keys()[1] + "\n")
    place = tmp_path / "place"
    place.mkdir()
    made = Archive(FolderObjects(place), members.keys("robot1"), "lab", tmp_path)
    with (tmp_path / "file").open("w+b") as file:
        with pytest.raises(ArchiveError, match=r"no secret key in keys of the team directory belongs to .* of team\.toml"):
            made.put_content(blake3().digest(), file)
    assert not list(place.iterdir())


def test_a_secret_key_of_another_name_that_cannot_be_used_hinders_nobody_and_one_alone_is_told(members: Members) -> None:
    other = team_directory.secret_key_path(members.of("robot1"), "before")
    other.write_text("")
    assert opened(seal(members.keys("robot2")), members.keys("robot1")) == b"the memory"
    team_directory.secret_key_path(members.of("robot1"), "robot1").unlink()
    with pytest.raises(TeamFileError, match=r"before\.secret"):
        members.keys("robot1")


def test_a_key_of_the_team_file_that_is_none_is_named(members: Members) -> None:
    robot = Robot(("127.0.0.1:1",), "127.0.0.1:2", "robot", "0" * 40)
    wrong = Team("lab", {**members.team.robots, "robot3": robot}, next_seat=9)
    with pytest.raises(ArchiveError, match=r"0000 is no public key of X25519: see the keys of team\.toml"):
        seal(members.keys("robot1", wrong))


def test_a_recovery_key_that_is_none_or_open_to_others_is_refused(members: Members) -> None:
    path = keys.recovery_path(members.of("robot1"))
    shutil.copy2(members.recovery, path)
    path.chmod(0o644)
    with pytest.raises(ArchiveError, match=r"archive\.recovery is open to others"):
        members.keys("robot1")
    path.chmod(0o600)
    path.write_text("ab\n")
    with pytest.raises(ArchiveError, match="is no recovery key: it is not 1 times 64 hexadecimal digits"):
        members.keys("robot1")
