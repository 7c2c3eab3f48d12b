"""Random numbers continue where they stood: the next draw is the one that would have come."""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from failover.errors import FitError, KeepError
from failover.state import Schema
from failover.state.random_numbers import FORMS
from tests.failover.state.sameness import forged, resumed

SOURCES = [getattr(np.random, name) for name in FORMS]
by_source = pytest.mark.parametrize("source", SOURCES, ids=list(FORMS))


def draws(generator: np.random.Generator) -> list[Any]:
    """Of every width, so that what is left over of one draw matters."""
    return [generator.integers(1 << 30, dtype=np.uint32), generator.normal(), *generator.integers(1 << 60, size=700).tolist()]


@dataclass
class Filter:
    """A particle filter, say."""

    dice: np.random.Generator = field(default_factory=lambda: np.random.default_rng(1))
    same: np.random.Generator | None = None
    old: random.Random = field(default_factory=lambda: random.Random(1))


@by_source
@pytest.mark.parametrize("before", [0, 1, 2, 701])
def test_a_generator_of_numpy_goes_on_where_it_stood(source: Any, before: int) -> None:
    generator = np.random.Generator(source(12))
    generator.integers(1 << 30, size=before, dtype=np.uint32)
    for annotation in (np.random.Generator, Any):
        again = resumed(annotation, generator)
        assert type(again) is np.random.Generator and type(again.bit_generator) is source
        assert draws(again) == draws(resumed(annotation, generator))
    assert draws(again) != draws(np.random.Generator(source(12))) or before == 0
    assert draws(resumed(Any, generator)) == draws(generator)


def test_a_generator_of_python_goes_on_where_it_stood() -> None:
    dice = random.Random(5)
    dice.gauss(0, 1)
    again = resumed(random.Random, dice)
    assert [again.gauss(0, 1) for _ in range(1000)] == [dice.gauss(0, 1) for _ in range(1000)]
    assert again.random() == dice.random()


def test_one_that_is_reached_by_two_ways_stays_one() -> None:
    value = Filter()
    value.same = value.dice
    again = resumed(Filter, value)
    assert again.same is again.dice
    assert again.old.random() == value.old.random()


def test_two_over_one_bit_generator_are_refused_by_both_names() -> None:
    value = Filter()
    value.same = np.random.Generator(value.dice.bit_generator)
    with pytest.raises(KeepError, match=r"cannot keep kept\.same: it draws from the bit generator of another one, \.dice"):
        resumed(Filter, value)


def test_a_bit_generator_of_somebody_else_is_refused() -> None:
    class Own(np.random.PCG64):
        pass

    with pytest.raises(
        KeepError, match="cannot keep kept: it holds a Generator, declared Generator; over a Own; numpy's own are"
    ):
        resumed(np.random.Generator, np.random.Generator(Own(1)))


def forged_with(name: str, **changed: Any) -> Any:
    """The stored form of a generator in which some parts are not what they were."""
    parts = {
        way: 0 if isinstance(form, int) else bytes(form[1] * np.dtype(form[0]).itemsize) for way, form in FORMS[name].items()
    }
    return {"$generator": [name, list({**parts, **changed}.values())]}


@pytest.mark.parametrize(
    ("wire", "sentence"),
    [
        (forged_with("MT19937", **{"state.pos": 625}), "not a number from 0 to 624"),
        (forged_with("MT19937", **{"state.pos": -1}), "not a number from 0 to 624"),
        (forged_with("MT19937", **{"state.key": bytes(4)}), "not 624 words"),
        (forged_with("Philox", buffer_pos=5), "not a number from 0 to 4"),
        (forged_with("PCG64", **{"state.inc": {"$int": bytes(17) + b"\1"}}), "not a number from 0 to"),
        (forged_with("PCG64", has_uint32=True), "not a number from 0 to 1"),
        ({"$generator": ["PCG64", []]}, "over 'PCG64'"),
        ({"$generator": ["default_rng", []]}, "over 'default_rng'; known are PCG64"),
        ({"$generator": "PCG64"}, "stored as a generator"),
        ({"$random": [bytes(2496) + b"\xff\xff\xff\xff", None]}, "invalid state"),
        ({"$random": [bytes(8), None]}, "not 625 words"),
        ({"$random": [bytes(2500), "x"]}, "stored as a random"),
    ],
)
def test_numbers_that_lead_nowhere_are_refused(wire: Any, sentence: str) -> None:
    with pytest.raises(FitError, match=sentence):
        Schema.of(Any, name="kept").decode(forged(wire))
