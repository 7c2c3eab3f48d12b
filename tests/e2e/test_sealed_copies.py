"""A witness keeps sealed copies: it can read none of its disk or memory, gives them back, and what it alters is refused.

With ``resume = true`` robots that lost their disks go on from them by themselves.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from failover.archive import keys, signature
from failover.cli.demo.robots import RobotMachine
from failover.config.team import Role
from tests.e2e import robots, teams
from tests.e2e.teams import TeamStage
from tests.e2e.test_archive import behind, is_gone, recovering, until
from tests.e2e.test_orders import counted

pytest.importorskip("cryptography")

pytestmark = [pytest.mark.root, pytest.mark.command("unshare"), pytest.mark.timeout(900)]

ROLES: dict[str, Role] = {"robot1": "robot", "robot2": "robot", "gate": "witness"}
BOOTS_FAST = "boot_patience_s = 1\npatience_s = 2\n"
PUTS = '[store]\nwitness = "gate"\ns3_every_s = 1\ns3_keep = 2\n'
OWN = {"robot1": PUTS, "robot2": PUTS, "gate": '[store]\nsealed_size = "1GB"\n'}
SEED = "the state of one component"
PAGES = 400
KEEPS_SECRETS = f"""
import hashlib, time
held = b"".join(hashlib.shake_256(b"{SEED} %d" % i).digest(4096) for i in range({PAGES}))
i = 0
while True:
    print(i, flush=True)
    i += 1
    time.sleep(0.01)
"""
"""Its memory has pages that nobody else has, and that no compression makes smaller; its command line does not."""

MARKER_SIZE = 32
MARKERS = [hashlib.shake_256(b"%s %d" % (SEED.encode(), i)).digest(4096)[2048:][:MARKER_SIZE] for i in range(0, PAGES, 50)]
"""From the middle of some of these pages."""

READ_SIZE = 16 << 20


@contextlib.contextmanager
def team(tmp_path: Path, more: str = "") -> Iterator[TeamStage]:
    """Two robots that put sealed copies into the keeping of a witness, and one program with secrets that is protected."""
    own = {name: table + (more if name != "gate" else "") for name, table in OWN.items()}
    with teams.acting(tmp_path, ROLES, BOOTS_FAST, own) as stage:
        first, second, _ = (stage.members[name].directory / "team" for name in ROLES)
        keys.new_key(first)
        shutil.copy2(keys.key_path(first), keys.key_path(second))
        keys.recovery_path(first).unlink()  # the robots' own keys open what the robots sealed
        robots.run(stage.members["robot1"], "count", "/usr/bin/python3", "-S", "-c", KEEPS_SECRETS)
        robots.until_protected(stage.members["robot1"])
        cure = "archive.public: No such file or directory; failover archive key writes it beside the archive key"
        until(lambda: any(cure in note for note in behind(stage.members["robot1"])), "the witness to miss its half of the key")
        signature.write_public(stage.members["gate"].directory / "team", keys.read_key(first))
        yield stage


def copies(gate: RobotMachine) -> list[Path]:
    """The copies of the component at the witness, the oldest first."""
    return sorted((gate.directory / "state" / "sealed").glob("demo/@*/*.sealed"))


def sealed_of(member: RobotMachine) -> dict[str, Any]:
    """What its status says of the sealed copies of the component."""
    return robots.component(member, "count").get("sealed") or {}


def is_primary(member: RobotMachine) -> bool:
    """Whether it says that it runs the component; False also while its agent starts anew."""
    with contextlib.suppress(*robots.NO_ANSWER):
        return bool(robots.component(member, "count").get("role") == "primary")
    return False


def is_plain(content: bytes) -> bool:
    """Whether a page of the program is in it."""
    return any(marker in content for marker in MARKERS)


def is_in_files(directory: Path) -> bool:
    """Whether a page of the program lies in a file below a directory."""
    found = False
    for path in directory.rglob("*"):
        with contextlib.suppress(FileNotFoundError):  # an older copy goes meanwhile
            found = found or (path.is_file() and is_plain(path.read_bytes()))
    return found


def is_in_memory(pid: int) -> tuple[bool, int]:
    """Whether a page of the program is in the memory of a process; and how many bytes of that were read."""
    found, size = False, 0
    with contextlib.suppress(FileNotFoundError, ProcessLookupError), open(f"/proc/{pid}/mem", "rb", buffering=0) as memory:
        for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
            first, last = (int(word, 16) for word in line.split()[0].split("-"))
            for at in range(first, last, READ_SIZE):
                with contextlib.suppress(OSError, ValueError, OverflowError):  # without the right to read, or of the kernel
                    memory.seek(at)
                    content = memory.read(min(READ_SIZE + MARKER_SIZE, last - at))
                    size += len(content)
                    found = found or is_plain(content)
    return found, size


def lose_disks(stage: TeamStage) -> None:
    """Both robots lose their power and their disks; what they are told at their set-up is on the new ones."""
    stage.cut_power("robot1", "robot2")
    for robot in (stage.members["robot1"], stage.members["robot2"]):
        until(lambda robot=robot: is_gone(robot), "everything of it to have ended")  # type: ignore[misc]
        for name in ("state", "run"):
            shutil.rmtree(robot.directory / name)


def test_nothing_of_a_program_is_readable_on_the_disk_or_in_the_memory_of_a_witness_that_keeps_it(tmp_path: Path) -> None:
    with team(tmp_path) as stage:
        first, second, gate = (stage.members[name] for name in ROLES)
        until(lambda: sealed_of(gate).get("copies"), "the witness to keep a copy")
        pid = robots.host_pid(first, robots.component(first, "count")["pid"])
        assert is_in_memory(pid)[0], "the program has what is searched for"
        assert is_in_files(second.directory / "state"), "the disk of a standby has it in plain"
        seen: set[str] = set()
        while len(seen) < 4:
            seen |= until(lambda: {path.name for path in copies(gate)} - seen, "another copy")  # noqa: B023
            assert not is_in_files(gate.directory)
            found = [is_in_memory(pid) for pid in gate.processes()]
            assert not any(is_found for is_found, _ in found) and sum(size for _, size in found) > 10 << 20
        print(f"searched {sum(size for _, size in found) >> 20} MB of memory of {len(found)} processes, after {len(seen)} copies")
        component = robots.component(first, "count")
        assert component["standby"] == "robot2" and component["protection"] == "protected"
        assert sealed_of(first)["at"] == "gate" and sealed_of(first)["copies"] is None
        assert re.search(
            r"sealed copy at gate, which is no standby: /demo/robot1/count, .* old", robots.failover(first, "status").stdout
        )
        assert re.search(
            r"sealed copies, which gate cannot open: /demo/robot1/count, \d+, .* old", robots.failover(gate, "status").stdout
        )
        stage.cut_power("robot1")
        robots.until_taken_over(second)
        until(lambda: sealed_of(second).get("at") == "gate", "the next primary to put copies")


def test_a_team_that_lost_every_disk_goes_on_from_the_witness_which_is_refused_where_it_alters_one(tmp_path: Path) -> None:
    with team(tmp_path) as stage:
        first, second, gate = (stage.members[name] for name in ROLES)
        until(lambda: sealed_of(gate).get("copies", 0) >= 2, "two copies")
        number, newest = counted(first)[-1], copies(gate)[-1].name
        until(lambda: copies(gate)[-1].name > newest, "a later copy")
        lose_disks(stage)
        older, newest_copy = copies(gate)[-2:]
        whole = newest_copy.read_bytes()
        for spoiled in (whole[:-1] + bytes([whole[-1] ^ 1]), whole[:-100], older.read_bytes()):
            newest_copy.write_bytes(spoiled)
            refused = recovering(second, "count")
            assert refused.returncode == 1 and f"{newest_copy.name} in the archive was altered, " in refused.stderr
            assert not list((second.directory / "state" / "store").rglob("*.base"))
        newest_copy.write_bytes(whole)
        said = recovering(second, "count")
        assert said.returncode == 0, said.stderr
        assert "robot2 holds /demo/robot1/count as robot1 archived it, epoch 1; start the agent" in said.stdout
        second = stage.switch_on("robot2")
        until(lambda: is_primary(second), "robot2, which may begin its next life first, to run it")
        stage.switch_on("robot1")
        until(lambda: counted(second) and counted(second)[-1] > number, "it to go on")
        numbers = counted(second)
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), "each number once, in order"
        robots.until_protected(second)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", ["robot1", "robot2"], ids=["the robot that ran it", "its standby"])
def test_with_resume_a_robot_that_is_back_without_its_disk_goes_on_from_the_witness(tmp_path: Path, name: str) -> None:
    with team(tmp_path, "resume = true\n") as stage:
        gate = stage.members["gate"]
        until(lambda: sealed_of(gate).get("copies", 0) >= 2, "two copies")
        number, newest = counted(stage.members["robot1"])[-1], copies(gate)[-1].name
        until(lambda: copies(gate)[-1].name > newest, "a later copy")
        lose_disks(stage)
        back = stage.switch_on(name)
        until(lambda: is_primary(back), f"{name} to run it")
        until(lambda: counted(back) and counted(back)[-1] > number, "it to go on")
        numbers = counted(back)
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), "each number once, in order"
        why = robots.failover(back, "why", "count").stdout
        assert f"{name} has its checkpoint" in why and "from the archive" in why
        stage.switch_on("robot2" if name == "robot1" else "robot1")
        robots.until_protected(back)
