"""Fencing in status: the sentence about the worst case depends on whether a hardware watchdog is fed."""

from __future__ import annotations

from pathlib import Path

import pytest

from agent.worker.control import fencing_status
from agent.worker.control.fencing_status import Watchdog


def machine(directory: Path, **facts: str) -> Path:
    place = directory / "watchdog0"
    place.mkdir()
    for name, fact in facts.items():
        (place / name).write_text(fact + "\n")
    return directory


def test_a_watchdog_that_is_fed_is_named_with_its_timeout(tmp_path: Path) -> None:
    found = fencing_status.watchdog(machine(tmp_path, state="active", identity="iTCO_wdt", timeout="30"))
    assert found == Watchdog("iTCO_wdt", 30)
    assert "its watchdog (iTCO_wdt) would reset it after 30 s" in fencing_status.sentence(found)


@pytest.mark.parametrize("facts", [{"state": "inactive"}, {"state": "inactive", "identity": "iTCO_wdt"}])
def test_a_watchdog_that_nobody_feeds_is_none(tmp_path: Path, facts: dict[str, str]) -> None:
    found = fencing_status.watchdog(machine(tmp_path, **facts))
    assert found is None
    assert "no hardware watchdog is active" in fencing_status.sentence(found)


@pytest.mark.parametrize(("facts", "name"), [({}, "watchdog0"), ({"identity": "iTCO_wdt"}, "iTCO_wdt")])
def test_a_watchdog_of_which_the_kernel_tells_nothing_is_not_called_one_that_nobody_feeds(
    tmp_path: Path, facts: dict[str, str], name: str
) -> None:
    found = fencing_status.watchdog(machine(tmp_path, **facts))
    assert found == Watchdog(name, 0, is_told=False)
    assert f"({name}) would help, and this kernel does not tell whether a program feeds it" in fencing_status.sentence(found)


def test_a_machine_without_watchdogs_is_told_so(tmp_path: Path) -> None:
    assert fencing_status.watchdog(tmp_path / "nothing") is None
