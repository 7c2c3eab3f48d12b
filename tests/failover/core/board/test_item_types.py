"""The type language: layouts equal to the C compiler's, one text for each type, and mistakes that say where they are."""

from __future__ import annotations

import random
import shutil
import subprocess
import sys
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from failover.core.board import c_header
from failover.core.board.item_types import (
    DEPTH_MAX,
    ITEM_SIZE_MAX,
    NUMBERS,
    Array,
    Number,
    Opaque,
    Record,
    Text,
    Type,
    alignment_of,
    canonical,
    of_table,
    offsets_of,
    parse,
    size_of,
    struct_format,
)
from failover.errors import ItemError

NAMES = st.from_regex(r"[a-z_][a-z0-9_]{0,6}", fullmatch=True)
LEAVES = st.one_of(st.builds(Number, st.sampled_from(list(NUMBERS))), st.builds(Text, st.integers(1, 20)))


def records(kinds: st.SearchStrategy[Any]) -> st.SearchStrategy[Record]:
    """Structs of one to six fields."""
    return st.dictionaries(NAMES, kinds, min_size=1, max_size=6).map(lambda fields: Record(tuple(fields.items())))


def arrays(kinds: st.SearchStrategy[Any]) -> st.SearchStrategy[Array]:
    """Arrays of one to four elements."""
    return st.builds(Array, kinds, st.integers(1, 4))


KINDS = st.recursive(LEAVES, lambda kinds: st.one_of(records(kinds), arrays(kinds)), max_leaves=6)
STRUCTS = records(KINDS)


def random_kind(dice: random.Random, depth: int) -> Type:
    """A type of any form; the deeper, the likelier a number."""
    form = dice.randrange(2 + (depth < 4) * 3)
    if form == 0:
        return Text(dice.randint(1, 20))
    if form == 2:
        return Array(random_kind(dice, depth + 1), dice.randint(1, 4))
    if form > 2:
        return random_struct(dice, depth + 1)
    return Number(dice.choice(list(NUMBERS)))


def random_struct(dice: random.Random, depth: int = 0) -> Record:
    """A struct of one to six fields."""
    return Record(tuple((f"f{place}", random_kind(dice, depth)) for place in range(dice.randint(1, 6))))


@pytest.mark.compiler
def test_two_hundred_random_structs_lie_in_memory_as_the_c_compiler_lays_them_out(tmp_path: Path) -> None:
    seed = random.SystemRandom().randrange(1 << 32)
    print("seed", seed)
    dice = random.Random(seed)
    structs = [record for record in (random_struct(dice) for _ in range(300)) if size_of(record) <= ITEM_SIZE_MAX][:200]
    assert len(structs) == 200
    lines = ["#include <stddef.h>", "#include <stdint.h>", "#include <stdbool.h>", "#include <stdio.h>", "int main(void) {"]
    expected = []
    for number, record in enumerate(structs):
        lines.append(f"typedef {c_header.declared(record, f'T{number}')};")
        lines.append(f'printf("T{number} %zu %zu\\n", sizeof(T{number}), _Alignof(T{number}));')
        expected.append(f"T{number} {size_of(record)} {alignment_of(record)}")
        for path, offset in c_header.offsets(record):
            lines.append(f'printf("T{number}.{path} %zu\\n", offsetof(T{number}, {path}));')
            expected.append(f"T{number}.{path} {offset}")
    source = tmp_path / "layouts.c"
    source.write_text("\n".join([*lines, "return 0; }"]))
    subprocess.run([shutil.which("gcc") or "cc", "-O0", "-w", "-o", tmp_path / "layouts", source], check=True)
    printed = subprocess.run([tmp_path / "layouts"], capture_output=True, text=True, check=True).stdout.splitlines()
    assert [(said, ours) for said, ours in zip(printed, expected, strict=True) if said != ours] == []


@given(STRUCTS)
def test_the_form_for_struct_has_every_byte_of_the_layout(record: Record) -> None:
    import struct

    assert struct.calcsize("<" + struct_format(record)) == size_of(record)
    assert size_of(record) % alignment_of(record) == 0
    assert all(offset % alignment_of(dict(record.fields)[name]) == 0 for name, offset in offsets_of(record).items())


@given(KINDS)
def test_the_text_of_a_type_is_read_back_as_the_type(kind: Type) -> None:
    assert parse(canonical(kind)) == kind
    assert parse(canonical(kind).replace(":", " : ").replace(",", " ,\n")) == kind


@given(st.one_of(st.text(max_size=30), st.text("{}[]:,fu48 charx", max_size=30)))
def test_any_text_is_a_type_or_a_mistake_that_says_what_was_expected(text: str) -> None:
    try:
        kind = parse(text)
    except ItemError as error:
        complaint = error
        assert (complaint.key, str(complaint) != "") == ("type", True)
    else:
        assert parse(canonical(kind)) == kind
        assert 1 <= size_of(kind) <= ITEM_SIZE_MAX


def test_a_table_is_the_same_type_as_its_text() -> None:
    table = {"x": "f4", "v": "f4[3]", "text": "char[16]", "pose": {"a": "f8", "ok": "bool"}, "near": "{x:f4,y:f4}[8]"}
    assert canonical(of_table(table)) == "{x:f4,v:f4[3],text:char[16],pose:{a:f8,ok:bool},near:{x:f4,y:f4}[8]}"
    assert of_table("msgpack[512]") == Opaque("msgpack", 512)


def deep(count: int) -> dict[str, Any]:
    """A table in a table, ``count`` times."""
    table: dict[str, Any] = {"x": "f4"}
    for _ in range(count):
        table = {"in": table}
    return table


@pytest.mark.parametrize(
    ("written", "said"),
    [
        ("f5", "at character 1 stands 'f5', expected a type"),
        ("f4[0]", "at character 3 stands '[0]', expected a number from 1 to 65536"),
        ("f4[3", "expected a number from 1"),
        ("char", "expected the most bytes of the text, as in char[16]"),
        ("{x:f4", "at character 6 stands the end, expected ',' or '}'"),
        ("{x f4}", "expected ':' behind the field's name 'x'"),
        ("{x:f4,x:f4}", "two fields are called 'x'"),
        ("f4 f4", "expected nothing more"),
        ("", "at character 1 stands the end, expected a type"),
        ("f8[9000]", "a value of 72000 bytes; an item holds 1 to 65536"),
        ("f8[9000][9000][9000]", "a value of"),
        ("[" * 5000, "expected a type"),
        ("{a:" * 5000, f"deeper than {DEPTH_MAX}"),
        ({}, "a struct of 0 fields"),
        ({"x": 4}, "field x: 4 is no type"),
        ({"x": {"y": "f5"}}, "field x.y: 'f5' is no type"),
        ({"x y": "f4"}, "'x y' cannot name a field"),
        ({"x": "msgpack"}, "field x: 'msgpack' is no type of a field"),
        (deep(20), f"deeper than {DEPTH_MAX}"),
    ],
)
def test_a_mistake_in_a_type_says_where_and_what_was_expected(written: Any, said: str) -> None:
    with pytest.raises(ItemError) as caught:
        of_table(written)
    assert said in str(caught.value)


def calls_to_parse(depth: int) -> int:
    """Of Python functions, for structs that lie so deep in each other."""
    text, calls = "u1", 0
    for _ in range(depth):
        text = f"{{a:u1,b:{text}}}"

    def count(frame: FrameType, event: str, argument: object) -> None:
        nonlocal calls
        calls += event == "call"

    before = sys.getprofile()
    sys.setprofile(count)
    try:
        parse(text)
    finally:
        sys.setprofile(before)
    return calls


def test_a_type_twice_as_deep_costs_twice_as_much() -> None:
    """Other robots announce types: a cost that doubles with each struct inside another would hold the main loop up."""
    assert calls_to_parse(DEPTH_MAX) < 3 * calls_to_parse(DEPTH_MAX // 2)
