"""``failover-agent recover``: a component comes from the archive into a robot's store, or nothing is changed."""

from __future__ import annotations

import re
import tempfile
import time
from pathlib import Path
from typing import BinaryIO

import msgspec
import pytest

from agent.main import main
from agent.main_loop.vote_record import VoteRecordFile
from checkpoint.snapshot import format
from checkpoint.store.store import open_store
from failover.archive import keys
from failover.archive.archive import Archive, Copy, Label
from failover.archive.objects import FolderObjects
from failover.config import team
from failover.config.team import Robot
from failover.core import vote_record as core_vote_record
from failover.core.types import SPAN, ComponentSpec, Launch, Record, State, VoteRecord
from tests.agent.test_mend import config
from tests.checkpoint.snapshots import page, pages_of, snapshot

__all__ = ["config"]

pytest.importorskip("cryptography")

COMPONENT = "/lab/robot9/planner"
SPEC = ComponentSpec(COMPONENT, home="robot9", launch=Launch(("mapper",)), owner=1000)


@pytest.fixture
def place(config: Path) -> Path:
    """An archive with two checkpoints, which the configuration names."""
    place = config.parent / "place"
    place.mkdir()
    with config.open("a") as file:
        file.write(f'[store]\ns3 = "{place}"\n')
    keys.new_key(config.parent / "team")
    for sequence in (1, 2):
        put(place, config, sequence)
    return place


def keys_at(config: Path) -> keys.Keys:
    """Those of its team directory."""
    directory = config.parent / "team"
    return keys.read_keys(directory, team.read(directory))


def records(config: Path) -> tuple[Record, ...]:
    return core_vote_record.decode(VoteRecordFile(config.parent / "state", "robot1").read().core).records


def recover(config: Path, *words: str) -> int:
    return main(["recover", *words, "--config", str(config)])


def test_the_newest_copy_is_in_the_store_and_on_record(config: Path, place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    enrol_robot9(config, "")
    before = records(config)
    assert recover(config, "planner") == 0
    said = capsys.readouterr().out
    assert said.startswith(f"robot1 holds {COMPONENT} as robot9 archived it, epoch 1; start the agent")
    assert "needs /usr/bin/mapper, which is neither here nor whole in the archive" in said
    assert f"{keys.recovery_path(config.parent / 'team')} opens every copy: move it to where no robot is again" in said
    *others, record = records(config)
    assert tuple(others) == before
    assert record == Record(COMPONENT, 1, state=State.STANDBY, spec=SPEC, begun=True)
    store = open_store(config.parent / "state" / "store")
    try:
        assert pages_of(store.load(COMPONENT)) == {1: page("2")}
    finally:
        store.close()
    assert recover(config, "planner") == 1
    assert "is on record at robot1" in capsys.readouterr().err and records(config)[-1] == record


def test_a_checkpoint_from_the_archive_is_as_old_as_its_state(
    config: Path, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By the file's age the agent tells how much work is lost; of that it takes off for how long this robot was off."""
    (config.parent / "state" / "last_alive").touch()
    newest = max(place.rglob("*.sealed"))
    sealed_at_s = int(newest.name.partition("-")[0], 16) / 1000
    time.sleep(1.1)
    assert recover(config, "planner") == 0
    assert re.search(r"this copy was sealed at .* UTC, \d+ s ago by the clock of robot1: the work since", capsys.readouterr().out)
    (kept,) = (config.parent / "state" / "store").rglob("*.base")
    assert abs(kept.stat().st_mtime - sealed_at_s) < 0.1
    assert not (config.parent / "state" / "last_alive").exists()


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        ("nothing named", "recover needs a component"),
        ("not there", "has no checkpoint of mapper"),
        ("altered", "was altered, cut off or sealed with another archive key"),
        ("another key", "was sealed with other keys than those that are here: for a new member"),
        ("no key", "failover archive key makes one"),
        ("no place", "mount the disk"),
        ("store in use", "another process has it open"),
        ("newer", "a specification that this version of failover cannot read"),
    ],
)
def test_what_cannot_be_recovered_changes_nothing(
    spoil: str, said: str, config: Path, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = records(config)
    key = keys.key_path(config.parent / "team")
    words = {"nothing named": (), "not there": ("mapper",)}.get(spoil, ("planner",))
    held = open_store(config.parent / "state" / "store") if spoil == "store in use" else None
    match spoil:
        case "altered":
            newest = max(place.rglob("*.sealed"))
            newest.write_bytes(newest.read_bytes()[:-1])
        case "another key" | "no key":
            key.unlink()
            if spoil == "another key":
                keys.recovery_path(config.parent / "team").unlink()
                keys.new_key(config.parent / "team")
        case "newer":
            with tempfile.TemporaryFile() as file:
                file.write(format.encode_bytes(snapshot({1: page("3")}, sequence=3, component=COMPONENT)))
                file.flush()
                Archive(FolderObjects(place), keys_at(config), "lab", config.parent).put(file, "robot9", b"x")
        case "no place":
            place.rename(place.with_name("elsewhere"))
    assert recover(config, *words) == 1
    told = capsys.readouterr()
    assert said in told.err and told.err.startswith("failover-agent: ") and told.out == ""
    assert records(config) == before
    if held is not None:
        held.close()
    store = open_store(config.parent / "state" / "store")
    assert store.components() == ()
    store.close()


def put(place: Path, config: Path, sequence: int) -> None:
    with tempfile.TemporaryFile() as file:
        file.write(format.encode_bytes(snapshot({1: page(str(sequence))}, sequence=sequence, component=COMPONENT)))
        file.flush()
        key = keys_at(config)
        Archive(FolderObjects(place), key, "lab", config.parent).put(file, "robot9", msgspec.msgpack.encode(SPEC))


@pytest.mark.parametrize("is_too_quick", [False, True])
def test_a_copy_that_newer_ones_replace_while_it_comes_gives_way_to_the_newest(
    is_too_quick: bool, config: Path, place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As the robot does that runs the component: it puts a newer copy, and removes the older ones."""
    fetch, sequences = Archive.fetch, iter(range(3, 100))

    def fetch_late(archive: Archive, copy: Copy, file: BinaryIO) -> Label:
        if (sequence := next(sequences)) == 3 or is_too_quick:
            older = list(place.rglob("*.sealed"))
            put(place, config, sequence)
            for path in older:
                path.unlink()
        return fetch(archive, copy, file)

    monkeypatch.setattr(Archive, "fetch", fetch_late)
    before = records(config)
    assert recover(config, "planner") == int(is_too_quick)
    if is_too_quick:
        assert "stop it first (failover stop), or set a larger s3_keep" in capsys.readouterr().err
        assert records(config) == before
        return
    store = open_store(config.parent / "state" / "store")
    assert pages_of(store.load(COMPONENT)) == {1: page("3")}
    store.close()


def test_without_an_archive_there_is_nothing_to_recover_from(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert recover(config, "planner") == 1
    assert "names no archive" in capsys.readouterr().err


def test_a_vote_record_of_none_gets_its_first_record(config: Path, place: Path) -> None:
    record_file = VoteRecordFile(config.parent / "state", "robot1")
    record_file.read()
    record_file.keep(core_vote_record.encode(VoteRecord()))
    assert recover(config, COMPONENT) == 0
    assert [one.name for one in records(config)] == [COMPONENT]


def have_on_record(config: Path, *known: Record) -> None:
    record_file = VoteRecordFile(config.parent / "state", "robot1")
    record_file.read()
    record_file.keep(core_vote_record.encode(VoteRecord(known)))


def enrol_robot9(config: Path, site: str) -> None:
    members = team.read(config.parent / "team")
    robot = Robot(("127.0.0.1:7430",), "127.0.0.1:7431", site=site)
    team.write(config.parent / "team", team.enrol(members, "robot9", robot))


def test_what_another_site_ran_goes_on_above_each_epoch_that_that_one_can_have_claimed(config: Path, place: Path) -> None:
    enrol_robot9(config, "harbour")
    assert recover(config, "planner") == 0
    assert records(config)[-1] == Record(COMPONENT, SPAN, state=State.STANDBY, spec=SPEC, begun=True)


def test_what_a_robot_ran_that_has_left_the_team_goes_on_in_the_next_span(config: Path, place: Path) -> None:
    """It may have been of another site, which may run it still."""
    assert "robot9" not in team.read(config.parent / "team").robots
    assert recover(config, "planner") == 0
    assert records(config)[-1].epoch == SPAN


def test_what_a_robot_of_this_site_ran_keeps_its_epoch(config: Path, place: Path) -> None:
    enrol_robot9(config, "")
    assert recover(config, "planner") == 0
    assert records(config)[-1].epoch == 1


def test_what_another_site_has_by_an_operators_order_is_brought_back(
    config: Path, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = Record("/lab/robot1/other", 3, "robot1", State.PRIMARY)  # robot9 has left the team since
    have_on_record(config, Record(COMPONENT, SPAN + 7, "robot9", State.STANDBY, spec=SPEC, begun=True, elsewhere=1), other)
    assert recover(config, "planner") == 0
    assert records(config) == (other, Record(COMPONENT, 2 * SPAN, state=State.STANDBY, spec=SPEC, begun=True))
    assert recover(config, "planner") == 1 and "is on record at robot1" in capsys.readouterr().err
