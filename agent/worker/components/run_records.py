"""Records the epoch and the terms under which each program on this robot runs: written before it runs, read by the next agent.

One small file per component in the runtime directory: it has to outlive the agent, not the robot.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

import msgspec

from checkpoint.device_rules import DeviceRule
from checkpoint.engine import NO_TERMS, NOTHING_CARRIED, Carry, Terms
from checkpoint.errors import UNDECODABLE
from checkpoint.store.index import folder_name
from checkpoint.store.whole_file import write_whole


class Running(msgspec.Struct, frozen=True, omit_defaults=True):
    """One note.

    Attributes:
        carry, devices: its terms as agents noted them that knew no others. They are read only: a program outlives its agent, and
            so the version that noted them.
    """

    component: str
    epoch: int
    terms: Terms = NO_TERMS
    carry: Carry = NOTHING_CARRIED
    devices: tuple[DeviceRule, ...] = ()

    @property
    def all_terms(self) -> Terms:
        """The terms of the component, from a note of any release."""
        return Terms(self.carry, self.devices) if self.terms == NO_TERMS else self.terms


class Records:
    """The notes of one robot."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)

    def note(self, component: str, epoch: int, terms: Terms = NO_TERMS) -> None:
        """From now on it runs under this epoch.

        Raises:
            OSError: it cannot be written; the program must not run.
        """
        write_whole(self._path(component), msgspec.json.encode(Running(component, epoch, terms)), lasts="process")

    def epoch(self, component: str) -> int:
        """The epoch under which it runs; 0 if no note of it exists."""
        noted = self._noted(component)
        return noted.epoch if noted else 0

    def terms(self, component: str) -> Terms:
        """The terms that its operator has ruled."""
        noted = self._noted(component)
        return noted.all_terms if noted else NO_TERMS

    def _noted(self, component: str) -> Running | None:
        try:
            return msgspec.json.decode(self._path(component).read_bytes(), type=Running)
        except (OSError, *UNDECODABLE):
            return None

    def forget(self, component: str) -> None:
        """It runs here no longer."""
        with contextlib.suppress(FileNotFoundError):
            self._path(component).unlink()

    def _path(self, component: str) -> Path:
        return self._directory / (folder_name(component) + ".running")
