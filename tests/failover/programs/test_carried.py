"""What a host under an agent keeps: unpacked on another robot, where everything about it is checked by that robot's own files."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from checkpoint.segment.task_messages import NAME_PREFIX, VARIABLE
from failover.core.programs import states
from failover.core.programs.states import Shelf, State, Version
from failover.errors import BundleRefusedError, ProgramError
from failover.programs.carried import Carried, kept_in, open_carried, unpack
from failover.programs.sources import Place, end_trial, source_of_store
from failover.programs.store import Store
from tests.failover.programs.senders import Lab, engine


def ran(lab: Lab, active: str, *, is_committed: bool = True) -> Carried:
    """What a robot keeps that has switched to a version, and has all that were sent."""
    shelf = lab.store.shelf("engine")
    for version in dict.fromkeys(("1", active)):
        shelf = states.succeed(shelf, states.warm(shelf.find(version)), "on trial")  # type: ignore[arg-type]
        if is_committed or version != active:
            shelf = states.put(shelf, states.commit(shelf.find(version), "healthy"))  # type: ignore[arg-type]
    lab.store.put(shelf)
    carried = Carried()
    carried.take_shelf(shelf, Place(lab.store, lab.team, "engine"))
    return carried


@pytest.fixture
def other(lab: Lab) -> Place:
    """Another robot's store, and its copy of the team directory."""
    team = lab.folder / "t2"
    team.mkdir()
    for name in ("programs.toml", "rights.toml"):
        (team / name).write_text((lab.team / name).read_text())
    return Place(Store(lab.folder / "s2").open(), team, "engine")


def test_another_robot_gets_the_active_version_and_the_one_before_it_checked_and_staged(lab: Lab, other: Place) -> None:
    for version in ("1", "2"):
        lab.send(version, engine(extra=f"return {version}"))
    carried = ran(lab, "2")
    assert len(carried.bundles) == 2
    unpack(carried, other)
    shelf = other.store.shelf("engine")
    assert [(one.version, str(one.state)) for one in shelf.versions] == [("1", "retired"), ("2", "active")]
    assert (shelf.floor, shelf.before) == ("2", "1")
    assert source_of_store(other, "").manifest.version == "2"
    lab.send("3", engine(extra="return 3"))
    other.store.take(lab.store.bundle(lab.store.shelf("engine").find("3").digest), other.team)  # type: ignore[union-attr]
    unpack(carried, other)
    assert [one.version for one in other.store.shelf("engine").versions] == ["1", "2", "3"], "one that a person sent there stays"


def test_a_trial_that_was_under_way_ends_on_another_robot_as_on_this_one(lab: Lab, other: Place) -> None:
    for version in ("1", "2"):
        lab.send(version, engine(extra=f"return {version}"))
    unpack(ran(lab, "2", is_committed=False), other)
    end_trial(other)
    assert source_of_store(other, "").manifest.version == "1"


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("programs.toml", "", "is signed by the key"),
        ("rights.toml", "", "may not program"),
        ("bundle", "", "was changed after"),
        ("unsigned", "", "has no signature"),
    ],
)
def test_a_bundle_that_may_not_run_there_does_not(lab: Lab, other: Place, file: str, content: str, words: str) -> None:
    lab.send("1")
    carried = ran(lab, "1")
    ((digest, bundle),) = carried.bundles.items()
    if file == "bundle":
        carried.bundles = {digest: bundle[:-2000] + bytes([bundle[-2000] ^ 1]) + bundle[-1999:]}
    elif file == "unsigned":
        carried.bundles = {digest: bundle[1024:]}
    else:
        (other.team / file).write_text(content)
    with pytest.raises(BundleRefusedError, match=words):
        unpack(carried, other)
    assert list(Path(other.store.place / "bundles").iterdir()) == [], "nothing of it is unpacked"
    assert other.store.find("engine") is None


def test_a_bundle_under_another_ones_name_is_refused_and_so_is_a_state_that_is_damaged_or_of_another_program(
    lab: Lab, other: Place
) -> None:
    for version in ("1", "2"):
        lab.send(version, engine(extra=f"return {version}"))
    carried = ran(lab, "2")
    one, two = carried.bundles.items()
    carried.bundles = {one[0]: two[1], two[0]: one[1]}
    with pytest.raises(BundleRefusedError, match="that came with the state has the content of"):
        unpack(carried, other)
    carried.bundles = {}
    with pytest.raises(ProgramError, match="the bundle of its active version did not come with its state"):
        unpack(carried, other)
    shelf = carried.shelf
    for carried.shelf in (b"{", b'{"name":"\xff"}', b'{"x":' + b"[" * 12_000):
        with pytest.raises(ProgramError, match="what came with the program's state is damaged"):
            unpack(carried, other)
    for damaged in (b"\xc1", b"\x81\xa1\xff\x01", b"\x81\xa1x" + b"\x91" * 12_000):
        with pytest.raises(ProgramError, match="what came with the program's state is damaged"):
            kept_in(damaged)
    carried.shelf = shelf
    with pytest.raises(ProgramError, match="is that of the program engine, and this host is for arm"):
        unpack(carried, msgspec.structs.replace(other, name="arm"))


def test_the_shelf_of_a_program_that_goes_on_is_that_of_where_it_ran_and_what_else_is_here() -> None:
    ran_there = Shelf(
        "engine",
        "Lab/Engine",
        (
            Version("1", "a", State.RETIRED),
            Version("2", "b", State.ACTIVE, True),
            Version("3", "c", State.STAGED),
        ),
        floor="2",
        before="1",
        uid=7,
    )
    here = Shelf("engine", "Lab/Engine", (Version("1.5", "d", State.ACTIVE, True), Version("4", "e", State.STAGED)), "1.5", "", 9)
    found = states.carried_over(ran_there, here, {"a", "b"})
    assert [(one.version, one.state) for one in found.versions] == [
        ("1", State.RETIRED),
        ("1.5", State.RETIRED),
        ("2", State.ACTIVE),
        ("4", State.STAGED),
    ]
    assert (found.floor, found.before, found.uid) == ("2", "1", 9)
    assert states.carried_over(ran_there, None, {"b"}).before == "", "a rollback needs its bundle"
    many = Shelf("engine", "Lab/Engine", tuple(Version(f"0.{number}", "x", State.STAGED) for number in range(1, 65)))
    assert len(states.carried_over(ran_there, many, {"a", "b"}).versions) == states.VERSIONS_MAX
    with pytest.raises(ProgramError, match="give one another name"):
        states.carried_over(ran_there, msgspec.structs.replace(here, path="Lab/Other"), {"b"})


def test_what_another_robot_could_not_check_does_not_run_under_an_agent(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, f"{NAME_PREFIX}{'0' * 16}")
    for place in (
        Place(lab.store, lab.team, "engine", lab.source("1")),
        Place(lab.store, lab.team, "engine", beside=True),
    ):
        with pytest.raises(ProgramError, match="under an agent: another robot takes over signed bundles only"):
            open_carried(place)


def test_a_bundle_that_is_here_with_a_newer_signature_stays(lab: Lab, other: Place) -> None:
    lab.send("1")
    carried = ran(lab, "1")
    ((digest, _),) = carried.bundles.items()
    newer = lab.bundle(lab.source("1"), until_s=4_000_000_000)
    other.store.take(newer, other.team)
    unpack(carried, other)
    assert other.store.bundle(digest) == newer
    (other.store.tree(digest) / "engine.py").unlink()
    unpack(carried, other)
    assert source_of_store(other, "").digest == digest, "one whose files were changed here comes again"


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({"name": "arm"}, "the shelf calls it arm 1 for Lab/robot1/Engine"),
        ({"path": "Lab/robot1/Arm"}, "the shelf calls it engine 1 for Lab/robot1/Arm"),
        ({"version": "9"}, "the shelf calls it engine 9 for Lab/robot1/Engine"),
    ],
)
@pytest.mark.parametrize("is_here", [False, True])
def test_a_shelf_that_says_something_else_than_its_bundle_is_refused(
    lab: Lab, other: Place, said: dict[str, str], words: str, is_here: bool
) -> None:
    lab.send("1")
    carried = ran(lab, "1")
    if is_here:
        (bundle,) = carried.bundles.values()
        other.store.take(bundle, other.team)
    shelf = msgspec.json.decode(carried.shelf, type=Shelf)
    if "version" in said:
        shelf = msgspec.structs.replace(shelf, versions=(msgspec.structs.replace(shelf.versions[0], version="9"),))
    else:
        shelf = msgspec.structs.replace(shelf, **said)
    carried.shelf = msgspec.json.encode(shelf)
    before = other.store.find("engine")
    with pytest.raises(ProgramError, match=f"{words}, and its manifest engine 1 for Lab/robot1/Engine|give one another name"):
        unpack(carried, msgspec.structs.replace(other, name=shelf.name))
    assert is_here or list(Path(other.store.place / "bundles").iterdir()) == []
    assert other.store.find("engine") == before and other.store.find("arm") is None


def test_a_bundle_that_is_only_here_counts_for_what_this_robot_knows_it_as(lab: Lab, other: Place) -> None:
    lab.send("1")
    carried = ran(lab, "1")
    other.store.take(lab.bundle(lab.source("7")), other.team)
    there = other.store.shelf("engine").find("7")
    assert there is not None
    shelf = msgspec.json.decode(carried.shelf, type=Shelf)
    forged = (*shelf.versions, Version("8", there.digest, State.RETIRED))
    carried.shelf = msgspec.json.encode(msgspec.structs.replace(shelf, versions=forged, before="8"))
    unpack(carried, other)
    assert [one.version for one in other.store.shelf("engine").versions] == ["1", "7"]


def test_the_floor_of_a_robot_does_not_sink_by_what_comes(lab: Lab, other: Place) -> None:
    lab.send("1")
    lab.send("2", engine(extra="return 2"))
    high, low = ran(lab, "2"), Carried()
    shelf = states.fall_back(lab.store.shelf("engine"), "a person took it back")
    low.take_shelf(shelf, Place(lab.store, lab.team, "engine"))
    unpack(high, other)
    unpack(low, other)
    found = other.store.shelf("engine")
    assert (found.active.version, found.floor) == ("1", "2")  # type: ignore[union-attr]
    assert "1 goes on here, older than 2" in str(other.store.lines("engine")[-1]["what"])
