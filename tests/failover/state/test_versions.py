"""A state moves between Python versions and numpy versions: other versions than those that run here wrote the sample."""

from __future__ import annotations

import dataclasses

import msgspec

from failover.state.schema import read
from tests.failover.state.sameness import same
from tests.samples.state import SAMPLE, Sampled, packed, sampled, schema, unpacked


def test_the_sample_is_read_as_it_was_written() -> None:
    decoded = schema().decode(unpacked(SAMPLE.read_bytes()))
    found, expected = decoded.value, sampled()
    assert decoded.notes == ()
    for field in dataclasses.fields(Sampled):
        if field.name not in ("ring", "plan"):
            assert same(getattr(found, field.name), getattr(expected, field.name)), field.name
    assert found.plan[:3] == expected.plan[:3] and found.plan[3] is found.plan[0]
    assert found.ring.next.name == "b" and found.ring.next.next is found.ring


def test_the_same_value_gives_the_bytes_of_the_sample() -> None:
    assert packed(schema().encode(sampled())) == SAMPLE.read_bytes()


def test_the_declaration_has_the_fingerprint_of_the_sample() -> None:
    data, _ = msgspec.msgpack.decode(SAMPLE.read_bytes())
    assert read(data).fingerprint == schema().fingerprint
