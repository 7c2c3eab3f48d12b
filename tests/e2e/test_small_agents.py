"""Which modules the processes of an agent without components have loaded, and which not."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path

from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.robot_processes import command_lines


def test_a_main_loop_and_its_worker_do_without_openssl_and_the_tables_of_names(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path) as (first, _):
        parts = {name: mapped_by(first, name) for name in ("agent.main", "agent.worker.process")}
        for mapped in parts.values():
            assert "_blake2" in sys.builtin_module_names or "_blake2" in mapped
            assert not [name for name in ("libcrypto", "libssl", "liblzma", "multiarray") if name in mapped]
            assert "unicodedata" not in mapped


def mapped_by(robot: RobotMachine, part: str) -> str:
    """The mappings of a part of its agent, by what stands in the command line."""
    for pid, words in command_lines(robot):
        if part in words[1:5]:
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # it has ended
                return Path(f"/proc/{pid}/maps").read_text()
    raise AssertionError(f"{robot.name} has no {part}")
