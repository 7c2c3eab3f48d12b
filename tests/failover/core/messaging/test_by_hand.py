"""Objects that a person types: found wherever the pieces are cut."""

from __future__ import annotations

import json

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from failover.core.messaging.by_hand import Typed
from failover.core.messaging.envelope import MESSAGE_SIZE_MAX
from failover.errors import EnvelopeError

values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@settings(suppress_health_check=list(HealthCheck))
@given(st.lists(st.dictionaries(st.text(), values, max_size=4), max_size=5), st.integers(1, 30), st.sampled_from([None, 2]))
def test_every_object_comes_out_as_it_went_in(objects: list[dict[str, object]], cut: int, indent: int | None) -> None:
    content = "\n ".join(json.dumps(one, ensure_ascii=False, indent=indent) for one in objects).encode(errors="surrogatepass")
    typed = Typed()
    found = [one for at in range(0, len(content), cut) for one in typed.take(content[at : at + cut])]
    assert [json.loads(one.decode(errors="surrogatepass")) for one in found] == objects


def test_three_lines_are_one_message() -> None:
    typed = Typed()
    assert typed.take(b'{"verb": "set",\n') == [] and typed.take(b' "body": {"duty": 1\n') == []
    assert typed.take(b"}}\n{") == [b'{"verb": "set",\n "body": {"duty": 1\n}}']


def test_what_is_no_object_is_refused() -> None:
    with pytest.raises(EnvelopeError, match=r"begins with \{, not with 'h'"):
        Typed().take(b"  hello\n")


def test_an_object_without_an_end_is_refused() -> None:
    typed = Typed()
    typed.take(b'{"a": "' + b"x" * (MESSAGE_SIZE_MAX - 10))
    with pytest.raises(EnvelopeError, match="no end"):
        typed.take(b"x" * 20)
