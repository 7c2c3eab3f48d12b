"""Models of attrs and pydantic are recognized by what they carry and kept; we never import either."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest

from failover.errors import KeepError
from tests.failover.state.sameness import moved, resumed

pytest.importorskip("attrs", reason="needs attrs: it is in requirements-dev.txt")
pytest.importorskip("pydantic", reason="needs pydantic: it is in requirements-dev.txt")

from tests.failover.state.libraries import Bolt, Extra, Fixed, Loose, Motor, Wheel


@pytest.mark.parametrize(
    ("annotation", "value"),
    [
        (Wheel, Wheel(0.5, [1, 2])),
        (list[Bolt], [Bolt(3), Bolt(4, "X")]),
        (dict[Bolt, int], {Bolt(3): 1}),
        (Loose, Loose(2.0, Loose(3.0))),
        (Motor, Motor(name="left", current=1.5, log=["on"])),
        (Fixed, Fixed(id=1, parent=Fixed(id=2))),
        (Wheel | Motor, Motor(name="x")),
    ],
)
def test_a_model_comes_back_as_it_was(annotation: Any, value: Any) -> None:
    found = resumed(annotation, value)
    assert found == value and type(found) is type(value)
    assert repr(found) == repr(value)


def test_a_frozen_model_with_a_remembered_hash_can_be_hashed_again() -> None:
    bolt = Bolt(3)
    hash(bolt)
    assert hash(resumed(Bolt, bolt)) == hash(bolt)


def test_a_model_knows_which_fields_were_set() -> None:
    motor = resumed(Motor, Motor(name="left"))
    assert motor.model_fields_set == {"name"}
    assert motor.model_dump(exclude_unset=True) == {"name": "left"}
    assert motor._open is False
    motor.log.append("works")


def test_a_model_takes_defaults_for_what_was_not_stored() -> None:
    found, notes = moved(dict[str, str], {"name": "left"}, Motor)
    assert (found.name, found.current, found.log) == ("left", 0.0, [])
    assert "kept.current: not stored: takes its default" in notes


def test_what_a_model_holds_besides_its_fields_is_refused_by_name() -> None:
    with pytest.raises(KeepError, match=r"kept\.surplus: it was set but is no declared field of Extra"):
        resumed(Extra, Extra(id=1, surplus=2))  # type: ignore[call-arg]


def test_neither_library_is_imported_by_us() -> None:
    script = "import sys, failover.state\nprint([name for name in ('attr', 'attrs', 'pydantic') if name in sys.modules])"
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "[]"
