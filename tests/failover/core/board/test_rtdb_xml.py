"""RTDB2's XML as items."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from failover.core.board.rtdb_xml import parse
from failover.errors import FileMistakeError

TEXT = """<!-- keys of a team -->
<RtDB2Configuration>
  <General>
    <DefaultKeyValue shared="false" period="1" phase="0" timeout="1.0"/>
    <Compressor name="zstd" dictionary="false"/>
  </General>
  <Keys>
    <key id="BALLS" shared="true"/>
    <key id="DIAG" period="5" phase="2" shared="true" oid="3"/>
    <key id="SETPOINT"/>
  </Keys>
</RtDB2Configuration>
"""


def test_keys_are_items_in_their_order_with_the_files_defaults() -> None:
    found = parse(TEXT.encode(), "f.xml")
    assert [(item.name, item.shared, item.period, item.phase, item.as_words()["type"]) for item in found] == [
        ("BALLS", True, 1, 0, "msgpack[1024]"),
        ("DIAG", True, 5, 2, "msgpack[1024]"),
        ("SETPOINT", False, 1, 0, "msgpack[1024]"),
    ]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('shared="true"/>', 'shared="yes"/>', "f.xml:8:5: key BALLS: shared is true or false, not 'yes'"),
        ('period="5"', 'period="-5"', "f.xml:9:5: key DIAG: period is a number of rounds, not '-5'"),
        ('period="5"', 'period="0"', "f.xml:9:5: key DIAG: period 0 is not from 1"),
        ('phase="2"', 'phase="5"', "f.xml:9:5: key DIAG: phase 5 is not from 0 to below the period, 5"),
        ('id="DIAG"', 'id="BALLS"', "f.xml:9:5: key BALLS is declared already, in line 8"),
        ('phase="2"', 'fase="2"', "f.xml:9:5: unknown attribute 'fase' of a key; did you mean 'phase'?"),
        ('id="DIAG" ', "", "f.xml:9:5: expected an attribute id"),
        ('id="DIAG"', 'id="A B"', "f.xml:9:5: key A B: 'A B' cannot name an item"),
        ("</Keys>", "</Key>", "f.xml:11:5: this is not XML: mismatched tag"),
        ("<RtDB2Configuration>", "<html>", "f.xml:2:1: expected the element RtDB2Configuration, found 'html'"),
        ("<RtDB2Configuration>", "<!DOCTYPE a SYSTEM 'b'><RtDB2Configuration>", "a document type is not read here"),
    ],
)
def test_a_mistake_says_where_it_is(old: str, new: str, said: str) -> None:
    assert TEXT.count(old) >= 1
    with pytest.raises(FileMistakeError) as caught:
        parse(TEXT.replace(old, new, 1).encode(), "f.xml")
    assert said in str(caught.value)


@given(st.one_of(st.binary(max_size=60), st.tuples(st.integers(0, len(TEXT) - 1), st.binary(max_size=2))))
def test_any_bytes_are_items_or_one_mistake_with_its_line(change: bytes | tuple[int, bytes]) -> None:
    content = TEXT.encode()
    content = change if isinstance(change, bytes) else content[: change[0]] + change[1] + content[change[0] + 1 :]
    try:
        parse(content, "f.xml")
    except FileMistakeError as error:
        told = re.match(r"f\.xml:\d+:\d+: ", str(error))
        assert (told is not None) is True
