"""Memory that control groups leave: the least of all that are around a process, in both versions."""

from __future__ import annotations

from pathlib import Path

import pytest

from checkpoint.engines.ptrace.facts import memory_limits
from checkpoint.linux import cgroup_memory

MIB = 1 << 20
PLENTY = 1 << 70


def group(directory: Path, **files: object) -> None:
    """Write files whose names have a dot for each double underscore."""
    directory.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (directory / name.replace("__", ".")).write_text(f"{content}\n")


def proc(directory: Path, mounts: str, groups: str) -> Path:
    group(directory / "proc", mountinfo=mounts, cgroup=groups)
    return directory / "proc"


def version_2(directory: Path, root: str = "/") -> Path:
    """A service with a limit inside a slice with a smaller one."""
    point = directory / "unified"
    group(point, cgroup__procs="")
    inner = {"memory__swap__max": 0, "memory__swap__current": 0}
    group(
        point / "robot.slice",
        memory__max=300 * MIB,
        memory__current=250 * MIB,
        memory__stat=f"anon {100 * MIB}\ninactive_file {20 * MIB}\nactive_file {10 * MIB}",
        memory__swap__max="max",
        memory__swap__current=0,
    )
    service = {"memory__max": 900 * MIB, "memory__current": 200 * MIB, "memory__stat": "anon 1\ninactive_file 0\nactive_file 0"}
    group(point / "robot.slice/agent.service", **service, **inner)
    inside = "/robot.slice/agent.service" if root == "/" else f"{root}/robot.slice/agent.service"
    mounts = f"41 31 0:38 {root} {point} rw,relatime shared:4 - cgroup2 cgroup2 rw"
    return proc(directory, mounts, f"1:cpu:/\n0::{inside}")


@pytest.mark.parametrize("root", ["/", "/docker/12ab"])
def test_the_group_around_that_leaves_least_counts(root: str, tmp_path: Path) -> None:
    assert cgroup_memory.left(0, version_2(tmp_path, root)) == 80 * MIB
    assert cgroup_memory.left(500 * MIB, version_2(tmp_path, root)) == 580 * MIB


def test_swap_that_a_group_may_not_have_is_not_counted(tmp_path: Path) -> None:
    place = version_2(tmp_path)
    group(tmp_path / "unified/robot.slice", memory__max="max")
    assert cgroup_memory.left(500 * MIB, place) == 700 * MIB


def test_groups_of_version_1_count(tmp_path: Path) -> None:
    point = tmp_path / "memory"
    unlimited = 9223372036854771712
    group(point, memory__limit_in_bytes=unlimited, memory__usage_in_bytes=0, memory__stat="total_inactive_file 0")
    group(
        point / "agent",
        memory__limit_in_bytes=200 * MIB,
        memory__usage_in_bytes=150 * MIB,
        memory__memsw__limit_in_bytes=220 * MIB,
        memory__memsw__usage_in_bytes=150 * MIB,
        memory__stat=f"total_inactive_file {5 * MIB}\ntotal_active_file {1 * MIB}",
    )
    place = proc(tmp_path, f"35 31 0:32 / {point} rw,relatime - cgroup cgroup rw,memory", "4:memory:/agent\n0::/")
    assert cgroup_memory.left(0, place) == 56 * MIB
    assert cgroup_memory.left(500 * MIB, place) == 76 * MIB


def test_where_no_group_limits_the_machine_does(tmp_path: Path) -> None:
    assert cgroup_memory.left(0, tmp_path / "nothing") == cgroup_memory.UNLIMITED
    group(tmp_path / "unified/a", memory__max="max", memory__current=5)
    place = proc(tmp_path, f"41 31 0:38 / {tmp_path}/unified rw - cgroup2 cgroup2 rw", "0::/a")
    assert cgroup_memory.left(0, place) == cgroup_memory.UNLIMITED


def test_odd_names_of_mounts_and_groups_are_no_ends_of_lines(tmp_path: Path) -> None:
    """Somebody without rights can mount a file system of his own below any name."""
    place = version_2(tmp_path)
    mounts, groups = (place / "mountinfo").read_text(), (place / "cgroup").read_text()
    odd = "36 31 0:50 / /home/a\x0bb\x1c\u2028c rw,nosuid - fuse.x x rw\n"
    (place / "mountinfo").write_text(odd + mounts)
    (place / "cgroup").write_text("5:cpu:/a\x0bb\n" + groups)
    assert cgroup_memory.left(0, place) == 80 * MIB


def test_what_is_free_here_is_what_the_groups_leave(monkeypatch: pytest.MonkeyPatch) -> None:
    assert 0 < memory_limits.free() < PLENTY
    monkeypatch.setattr(cgroup_memory, "left", lambda _: 3 * MIB)
    assert memory_limits.free() == 3 * MIB
