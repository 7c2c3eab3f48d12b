"""rtdb.conf: a team's whole file, each rule of the grammar, mistakes with line and column, and any bytes."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from failover.core.board.items import Board
from failover.core.board.rtdb_conf import (
    KEYWORDS,
    Assignment,
    Configuration,
    ConfItem,
    Schema,
    as_items,
    parse,
    shares,
    text_of,
)
from failover.errors import FileMistakeError, ItemError

SAMPLE = Path(__file__).parents[3] / "samples" / "rtdb.conf"


def read(text: str) -> Configuration:
    """The configuration of a text."""
    return parse(text.encode(), "rtdb.conf")


def refused(text: str) -> str:
    """What is said of a text."""
    with pytest.raises(FileMistakeError) as caught:
        read(text)
    return str(caught.value)


def test_the_file_of_a_whole_team_is_read() -> None:
    found = parse(SAMPLE.read_bytes(), "rtdb.conf")
    assert [len(part) for part in (found.agents, found.items, found.schemas, found.assignments)] == [7, 21, 2, 2]
    assert found.items[2] == ConfItem("COACH_INFO", "CoachInfo", "CoachInfo.h", 1)
    assert found.notes == ("rtdb.conf:25: item JOYSTICK is in no schema: no agent has it",)


def test_one_item_is_shared_by_one_agent_and_private_at_others() -> None:
    found = parse(SAMPLE.read_bytes(), "rtdb.conf")
    assert shares(found)["COACH_INFO"] == (found.agents, ("BASE",))
    board = Board(as_items(found, {item.name: 24 for item in found.items}, {}))
    assert board.number_of("COACH_INFO") == 2
    coach = board.items[2]
    assert (coach.is_shared_by("BASE"), coach.is_shared_by("PLAYER_1"), coach.is_at("PLAYER_1")) == (True, False, True)
    assert list(board.shared_by("PLAYER_3")) == [0, 1]
    assert not any(board.items[13].is_at(agent) for agent in found.agents)


def test_an_item_that_is_too_large_for_the_radio_is_named() -> None:
    found = parse(SAMPLE.read_bytes(), "rtdb.conf")
    with pytest.raises(ItemError, match="item WORLD: a shared item holds at most 4096 bytes, this one 5000"):
        as_items(found, {item.name: 5000 for item in found.items}, {})


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", Configuration()),
        ("# nothing\n\n", Configuration()),
        ("ITEM A { datatype = T }", ("T", "T.h", 1)),
        ("ITEM A\n\n{ period = 3; datatype = T\n headerfile = U.h\n}\n", ("T", "U.h", 3)),
        ("ITEM\tA{datatype=T;period=0007;}\r\n", ("T", "T.h", 7)),
        ("ITEM A { datatype = T; period = OFTEN }", ("T", "T.h", 1)),
    ],
)
def test_the_forms_of_an_item(text: str, expected: object) -> None:
    found = read(text)
    if isinstance(expected, Configuration):
        assert found == expected
    else:
        assert [(item.datatype, item.headerfile, item.period) for item in found.items] == [expected]


def test_what_cambadas_documentation_promises_is_read_though_its_parser_refuses_it() -> None:
    found = read(
        "AGENTS = A,\n B;\nITEM I { datatype = T; period = 3; }\n"
        "SCHEMA S { shared = I\n}\nASSIGNMENT { agents = A,\nB schema = S }"
    )
    assert found.agents == ("A", "B")
    assert found.items[0].period == 3
    assert found.assignments == (Assignment("S", ("A", "B")),)


def test_a_schema_that_is_named_twice_grows_and_what_is_listed_twice_counts_once() -> None:
    items = "ITEM I { datatype = T }\nITEM J { datatype = T }\n"
    found = read(items + "SCHEMA S { shared = I, I; local = J }\nSCHEMA S { local = J, I shared = J, I }\n")
    assert found.schemas == (Schema("S", ("I", "J"), ("J", "I")),)
    assert any("schema S lists I in both; it is shared" in note for note in found.notes)


GOOD = "AGENTS = A, B\nITEM I { datatype = T; }\nSCHEMA S { shared = I }\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("AGENT = A\n", "1:1: expected one of AGENTS, ITEM, SCHEMA, ASSIGNMENT, found 'AGENT'; did you mean 'AGENTS'?"),
        ("AGENTS = A B\n", "1:12: AGENTS: expected a line break behind the agents, found 'B'"),
        ("AGENTS = A, A\n", "1:13: AGENTS: agent A is declared already, in line 1"),
        ("AGENTS A\n", "1:8: AGENTS: expected '=', found 'A'"),
        ("AGENTS = ITEM\n", "1:10: AGENTS: expected the name of an agent; ITEM is a keyword and names nothing, found 'ITEM'"),
        ("ITEM 3 { }", "1:6: expected the name of an item, found '3'"),
        ("ITEM I { }", "1:10: item I: expected a field datatype before the '}', found '}'"),
        ("ITEM I { datatyp = T }", "1:10: item I: expected datatype, headerfile, period or '}', found 'datatyp'; did you mean"),
        ("ITEM I { datatype = T period = 3 }", "1:23: item I: expected ';', a line break or '}' behind datatype, found 'period'"),
        ("ITEM I { datatype = T; datatype = T }", "1:24: item I: expected each field once, and 'datatype' is there twice"),
        ('ITEM I { datatype = T; headerfile = "T.h" }', "1:37: expected a word, a number or one of = ; , { }, found '\"'"),
        ("ITEM I { datatype = T; headerfile = T.hpp }", '1:37: item I: "headerfile" names a file NAME.h, not "T.hpp"'),
        ("ITEM I { datatype = T; headerfile = T }", '1:37: item I: "headerfile" names a file NAME.h, not "T"'),
        (
            "ITEM I { datatype = T; period = 0 }",
            "1:33: item I: expected a number of rounds from 1 to 65536 behind period, found '0'",
        ),
        ("ITEM I { datatype = T; period = 3s }", "1:33: item I: expected a number of rounds"),
        ("ITEM I { datatype = T; period = 99999999999999999999 }", "1:33: item I: expected a number of rounds"),
        (
            "ITEM I { datatype = T;\n\nITEM J",
            "3:1: item I (begun in line 1): expected datatype, headerfile, period or '}', found 'ITEM'",
        ),
        ("ITEM I\n", "2:1: item I (begun in line 1): expected '{', found the end of the file"),
        (GOOD + "ITEM I { datatype = T }", "4:6: item I is declared already, in line 2"),
        (GOOD + "SCHEMA T { }", "4:12: schema T: expected a list shared or local before the '}', found '}'"),
        (GOOD + "SCHEMA T { shared = J }", "4:21: schema T: no item J is declared above"),
        (GOOD + "SCHEMA T { shared = I, }", "4:24: schema T: expected the name of an item, found '}'"),
        (
            "ITEM WORLD { datatype = T }\nSCHEMA S { local = WORLT }",
            "no item WORLT is declared above; did you mean 'WORLD' of line 1?",
        ),
        (
            "#ITEM W { datatype = T }\nSCHEMA S { local = W }",
            "2:20: schema S: no item W is declared above (line 1 has it behind a '#')",
        ),
        (GOOD + "ASSIGNMENT { schema = S }", "4:25: assignment: expected a field agents before the '}', found '}'"),
        (GOOD + "ASSIGNMENT { agents = A }", "4:25: assignment: expected a field schema before the '}', found '}'"),
        (GOOD + "ASSIGNMENT { agents = C; schema = S }", "4:23: assignment: no agent C is declared above"),
        (GOOD + "ASSIGNMENT { agents = A; schema = Q }", "4:35: assignment: no schema Q is declared above"),
        (
            GOOD + "ASSIGNMENT { schema = S; schema = S }",
            "4:26: assignment: expected one schema in an assignment, and this is a second",
        ),
    ],
)
def test_a_mistake_says_where_it_is_and_what_was_expected(text: str, said: str) -> None:
    message = refused(text)
    assert f"rtdb.conf:{said}" in message if said[0].isdigit() else said in message
    assert "\n  " in message
    assert message.endswith("^")


def test_the_caret_stands_below_the_word_also_in_a_long_line() -> None:
    message = refused("ITEM I { " + "period = 1;" * 1 + " " * 300 + "x = 1 }")
    _, line, caret = message.split("\n")
    assert line[caret.index("^")] == "x"
    assert len(line) < 130


LETTERS = ("", "#", "{", "}", ";", ",", "=", "x", "9", ".", "\n", "\0", "é")
HIDING = ("#", ";", "\0", "é")
"""What makes a comment of a line, or joins one to a comment: then a name is missed far below."""


@pytest.mark.parametrize("turn", range(3))
def test_a_file_with_any_one_letter_damaged_is_read_or_its_line_is_named(turn: int) -> None:
    text = SAMPLE.read_text()
    refusals = 0
    for at in range(len(text)):
        letter = LETTERS[(at * 3 + turn * 4) % len(LETTERS)]
        damaged = text.count("\n", 0, at) + 1
        try:
            parse((text[:at] + letter + text[at + 1 :]).encode(), "f")
        except FileMistakeError as error:
            refusals += 1
            first = str(error).partition("\n")[0]
            named = int(first.split(":")[1])
            begun = [int(number) for number in re.findall(r"line (\d+)", first)]
            near = {damaged, damaged + 1}  # a damaged line break joins two lines, another one parts them
            if not near.intersection((named, *begun)) and not (begun and begun[0] <= damaged <= named) and letter not in HIDING:
                raise AssertionError(f"letter {at} of line {damaged}: {first}") from error
    assert refusals > 500


NAMES = st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,6}", fullmatch=True).filter(lambda name: name not in KEYWORDS)


def some(names: list[str]) -> st.SearchStrategy[tuple[str, ...]]:
    """A few of these, each once."""
    return st.lists(st.sampled_from(names), unique=True).map(tuple) if names else st.just(())


@st.composite
def configurations(draw: st.DrawFn) -> Configuration:
    """Any configuration that a file can say."""
    agents = draw(st.lists(NAMES, unique=True, max_size=4))
    items = [
        ConfItem(name, draw(NAMES), draw(NAMES) + ".h", draw(st.integers(1, 65536)))
        for name in draw(st.lists(NAMES, unique=True, max_size=4))
    ]
    names = [item.name for item in items]
    schemas = [Schema(name, draw(some(names)), draw(some(names))) for name in draw(st.lists(NAMES, unique=True, max_size=3))]
    schemas = [schema for schema in schemas if schema.shared or schema.local]
    assignments = []
    if agents and schemas:
        for _ in range(draw(st.integers(0, 3))):
            chosen = draw(st.lists(st.sampled_from(agents), unique=True, min_size=1))
            assignments.append(Assignment(draw(st.sampled_from(schemas)).name, tuple(chosen)))
    return Configuration(tuple(agents), tuple(items), tuple(schemas), tuple(assignments))


@settings(max_examples=50)
@given(configurations())
def test_what_is_written_is_read_as_it_was(configuration: Configuration) -> None:
    found = read(text_of(configuration))
    assert (found.agents, found.items, found.schemas, found.assignments) == (
        configuration.agents,
        configuration.items,
        configuration.schemas,
        configuration.assignments,
    )


WORDS = st.sampled_from(
    [*KEYWORDS, "A", "B", "=", ",", ";", "{", "}", "\n", "#", "T.h", "3", ".", "é", "\0", "\r\n", "A.B.h"]
).map(str.encode)


@given(st.one_of(st.binary(max_size=60), st.lists(WORDS, max_size=30).map(b" ".join)))
def test_any_bytes_are_a_configuration_or_one_mistake_with_its_line(content: bytes) -> None:
    try:
        parse(content, "f")
    except FileMistakeError as error:
        told = re.match(r"f:(\d+):(\d+): ", str(error))
        assert (told is not None and int(told[1]) <= content.count(b"\n") + 1) is True


def test_a_file_that_is_far_too_large_is_refused() -> None:
    assert "over the limit" in refused("#" * (1 << 21))
