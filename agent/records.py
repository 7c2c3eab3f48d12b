"""Under which epoch each program on this robot was let run, and what it carries: noted before it runs, read by the next agent.

One small file a component in the runtime directory: it has to outlive the agent, not the robot.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

import msgspec

from checkpoint.device_rules import DeviceRule
from checkpoint.engine import NOTHING_CARRIED, Carry
from checkpoint.shelf import folder_name


class Running(msgspec.Struct, frozen=True):
    """One note."""

    component: str
    epoch: int
    carry: Carry = NOTHING_CARRIED
    devices: tuple[DeviceRule, ...] = ()


class Records:
    """The notes of one robot."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)

    def note(self, component: str, epoch: int, carry: Carry = NOTHING_CARRIED, devices: tuple[DeviceRule, ...] = ()) -> None:
        """From now on it runs under this epoch.

        Raises:
            OSError: it cannot be written; the program must not run.
        """
        path = self._path(component)
        aside = path.with_suffix(".new")
        aside.write_bytes(msgspec.json.encode(Running(component, epoch, carry, devices)))
        aside.replace(path)

    def epoch(self, component: str) -> int:
        """Under which it runs; 0 if nobody noted it."""
        noted = self._noted(component)
        return noted.epoch if noted else 0

    def carry(self, component: str) -> Carry:
        """Which files travel with it."""
        noted = self._noted(component)
        return noted.carry if noted else NOTHING_CARRIED

    def devices(self, component: str) -> tuple[DeviceRule, ...]:
        """What becomes of devices that it has open."""
        noted = self._noted(component)
        return noted.devices if noted else ()

    def _noted(self, component: str) -> Running | None:
        try:
            return msgspec.json.decode(self._path(component).read_bytes(), type=Running)
        except (OSError, msgspec.MsgspecError):
            return None

    def forget(self, component: str) -> None:
        """It runs here no longer."""
        with contextlib.suppress(FileNotFoundError):
            self._path(component).unlink()

    def _path(self, component: str) -> Path:
        return self._directory / (folder_name(component) + ".running")
