"""Names in simulated worlds: paths below them, aliases of their own, and nothing that could be taken for something real."""

from __future__ import annotations

import pytest

from failover.core.naming import worlds
from failover.core.naming.records import Record, pack
from failover.core.naming.tables import Entry, Table
from failover.core.naming.tree import Claims, Reach, Tree
from failover.errors import NameFormatError, NameUnknownError

REAL, TWIN = "University/Lab/Robotino/Engine", "Simulated/University/Lab/Robotino/Engine"


def tree(*paths: str) -> Tree:
    entries = {path: Entry(path, 1, pack(Record(path, aliases=("engine",)))) for path in paths}
    return Tree([Table("robot1", 1, 1, "", entries)], {"robot1": Reach.LIVE}, Claims(frozenset({"robot1", "Robotino"})))


@pytest.mark.parametrize("name", [REAL, f"/{REAL}", REAL.replace("/", " → "), "engine", TWIN])
def test_a_program_of_a_world_finds_what_is_simulated_by_the_names_of_the_real_things(name: str) -> None:
    for there in (tree(REAL, TWIN), tree(TWIN)):
        assert there.resolve(name, "Simulated").record.path == TWIN


def test_a_program_of_the_real_world_never_finds_a_simulated_thing_by_a_real_name() -> None:
    for name in (REAL, "engine"):
        with pytest.raises(NameUnknownError):
            tree(TWIN).resolve(name)
    assert tree(TWIN).resolve(TWIN).record.path == TWIN


def test_what_is_simulated_is_in_no_robots_subtree() -> None:
    claims = Claims(frozenset({"robot1", "Robotino"}))
    assert claims.refusal(REAL, "robot1") and not claims.refusal(TWIN, "robot1")


@pytest.mark.parametrize(
    "world", ["University", "Simulators", "simulated", "Simulated/../University", "Simulated//x", "Simulated/a b"]
)
def test_a_world_that_could_be_something_real_is_refused(world: str) -> None:
    with pytest.raises(NameFormatError, match="FAILOVER_WORLD"):
        worlds.checked(world)


def test_a_path_is_moved_into_a_world_once() -> None:
    assert (
        worlds.within("Simulated/North", "Lab/r")
        == "Simulated/North/Lab/r"
        == worlds.within("Simulated/North", "Simulated/North/Lab/r")
    )
    assert worlds.within("", "Lab/r") == "Lab/r"
    assert worlds.checked("/Simulated/North/") == "Simulated/North" and worlds.checked("") == ""
    assert worlds.guest("Simulated/North", "r") == "Simulated.North.r"
