"""What the next agent reads of a program that runs on: under the terms of any version."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from agent.worker.components.run_records import Records
from checkpoint.device_rules import DeviceRule
from checkpoint.engine import NO_TERMS, Carry, Terms

NAME = "/lab/x"
CARRY = Carry(("/srv/maps",))
DEVICES = (DeviceRule("/dev/ttyUSB0"),)


@pytest.mark.parametrize("terms", [NO_TERMS, Terms(CARRY, DEVICES, connections=True)])
def test_epoch_and_terms_are_read_as_they_were_noted(terms: Terms, tmp_path: Path) -> None:
    Records(tmp_path).note(NAME, 3, terms)
    assert (Records(tmp_path).epoch(NAME), Records(tmp_path).terms(NAME)) == (3, terms)


def test_what_an_older_agent_noted_still_holds(tmp_path: Path) -> None:
    Records(tmp_path).note(NAME, 3)
    (note,) = tmp_path.iterdir()
    note.write_bytes(msgspec.json.encode({"component": NAME, "epoch": 3, "carry": CARRY, "devices": DEVICES}))
    assert (Records(tmp_path).epoch(NAME), Records(tmp_path).terms(NAME)) == (3, Terms(CARRY, DEVICES))
