"""CAMBADA's ``rtdb.conf``: agents, items, and which agent shares or keeps which item; read with line and column, and written.

::

    file       = { nl | agents | item | schema | assignment } ;
    agents     = "AGENTS" "=" ids [";"] ( nl | end ) ;
    item       = "ITEM" id {nl} "{" { nl | field ( ";" | nl | &"}" ) } "}" ;
    field      = "datatype" "=" id | "headerfile" "=" id ".h" | "period" "=" ( number | id ) ;
    schema     = "SCHEMA" id {nl} "{" { nl | ("shared" | "local") "=" ids [";"] } "}" ;
    assignment = "ASSIGNMENT" {nl} "{" { nl | "schema" "=" id [";"] | "agents" "=" ids [";"] } "}" ;
    ids        = id { "," [nl] id } ;    comment = "#" … end of line ;    blanks between all tokens

The grammar takes all that CAMBADA's own parser takes, and all that its documentation promises besides: ``period = 3`` is a syntax
error there, and so is a line break in a list of agents. Numbers of items and agents are their places in the file, from 0. A
schema named twice grows; an item or an agent listed twice counts once.

Source: xrtdb.y, xrtdb.lex and README of CAMBADA/cambada-pub.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final, NoReturn

from msgspec import Struct

from checkpoint.sentences import near
from failover.core.board.items import PERIOD_MAX, Item
from failover.errors import FileMistakeError, ItemError

TEXT_SIZE_MAX: Final = 1 << 20
"""Bytes of a file; those of real teams have five thousand."""

SECTIONS: Final = ("AGENTS", "ITEM", "SCHEMA", "ASSIGNMENT")
FIELDS: Final = ("datatype", "headerfile", "period", "shared", "local", "schema", "agents")
KEYWORDS: Final = frozenset((*SECTIONS, *FIELDS))
"""None of them can name anything."""


class ConfItem(Struct, frozen=True):
    """One ITEM. ``datatype``: a C type, declared in ``headerfile``; ``period``: rounds between transmissions."""

    name: str
    datatype: str
    headerfile: str
    period: int = 1


class Schema(Struct, frozen=True):
    """One SCHEMA: the items that an agent of it sends to the others, and those that it keeps for itself."""

    name: str
    shared: tuple[str, ...] = ()
    local: tuple[str, ...] = ()


class Assignment(Struct, frozen=True):
    """One ASSIGNMENT: the agents of a schema."""

    schema: str
    agents: tuple[str, ...]


class Configuration(Struct, frozen=True):
    """A whole file.

    Attributes:
        notes: sentences about lines that are allowed and probably not meant.
        lines: where each item is declared, from 1.
    """

    agents: tuple[str, ...] = ()
    items: tuple[ConfItem, ...] = ()
    schemas: tuple[Schema, ...] = ()
    assignments: tuple[Assignment, ...] = ()
    notes: tuple[str, ...] = ()
    lines: tuple[int, ...] = ()


def parse(content: bytes, source: str) -> Configuration:
    """Read a file's content.

    Args:
        source: the file's name, for messages.

    Raises:
        FileMistakeError: "file:line:column: what was expected", and the line.
    """
    if len(content) > TEXT_SIZE_MAX:
        raise FileMistakeError(f"{source}:1:1: {len(content)} bytes are over the limit of {TEXT_SIZE_MAX}; is this an rtdb.conf?")
    return _Parser(content.decode(errors="surrogateescape"), source).file()


def text_of(configuration: Configuration) -> str:
    """The file that `parse` reads as this configuration."""
    lines = [f"AGENTS = {', '.join(configuration.agents)};"] if configuration.agents else []
    for item in configuration.items:
        lines.append(
            f"ITEM {item.name} {{ datatype = {item.datatype}; headerfile = {item.headerfile}; period = {item.period}; }}"
        )
    for schema in configuration.schemas:
        lists = [(word, listed) for word, listed in (("shared", schema.shared), ("local", schema.local)) if listed]
        lines += [f"SCHEMA {schema.name}", "{", *(f"    {word} = {', '.join(listed)};" for word, listed in lists), "}"]
    for one in configuration.assignments:
        lines.append(f"ASSIGNMENT {{ schema = {one.schema}; agents = {', '.join(one.agents)}; }}")
    return "\n".join([*lines, ""])


def shares(configuration: Configuration) -> dict[str, tuple[tuple[str, ...], tuple[str, ...]]]:
    """Item → (the agents that have it, those of them that share it), in the order of the agents."""
    schemas = {schema.name: schema for schema in configuration.schemas}
    having: dict[str, set[str]] = {item.name: set() for item in configuration.items}
    sharing: dict[str, set[str]] = {item.name: set() for item in configuration.items}
    for assignment in configuration.assignments:
        schema = schemas[assignment.schema]
        for name in schema.shared:
            sharing[name].update(assignment.agents)
        for name in (*schema.shared, *schema.local):
            having[name].update(assignment.agents)
    ordered = configuration.agents
    return {
        name: (
            tuple(agent for agent in ordered if agent in having[name]),
            tuple(agent for agent in ordered if agent in sharing[name]),
        )
        for name in having
    }


def as_items(configuration: Configuration, sizes: Mapping[str, int], robots: Mapping[str, str]) -> tuple[Item, ...]:
    """The items of a board, with the numbers that CAMBADA gives them.

    Args:
        sizes: item → ``sizeof`` of its datatype, bytes.
        robots: agent → robot; an agent that is not in it is the robot of the same name.

    Raises:
        ItemError: an item is not possible here; names it.
    """
    found = []
    who = shares(configuration)
    for item in configuration.items:
        having, sharing = (tuple(robots.get(agent, agent) for agent in agents) for agents in who[item.name])
        shared = bool(sharing) if sharing in (having, ()) else sharing
        try:
            found.append(Item(item.name, size=sizes[item.name], shared=shared, period=item.period, robots=having))
        except ItemError as error:
            raise ItemError(f"item {item.name}: {error}", error.key) from error
    return tuple(found)


# --- Words of a file -------------------------------------------------------------------------------------------------


class _Token(Struct, frozen=True):
    """One word. ``kind``: id, file, number, a mark itself, nl, end; ``line`` and ``column`` from 1."""

    kind: str
    text: str
    line: int
    column: int


_TOKEN = re.compile(
    r"""(?P<blank>[ \t\r]+ | \#[^\n]*)
      | (?P<nl>\n)
      | (?P<word>[A-Za-z_][A-Za-z0-9_]*(?:\.[A-Za-z0-9_.]*)?)
      | (?P<number>[0-9]+[A-Za-z0-9_]*)
      | (?P<mark>[=;,{}])""",
    re.VERBOSE,
)
_FILE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\.h")

_SAID: Final = {"nl": "a line break", "end": "the end of the file", "id": "a name", "file": "a file NAME.h", "number": "a number"}


def _tokens(text: str, fail: _Parser) -> list[_Token]:
    found, at, line, begin = [], 0, 1, 0
    while at < len(text):
        match = _TOKEN.match(text, at)
        if match is None:
            fail.mistake(_Token("odd", text[at], line, at - begin + 1), "a word, a number or one of = ; , { }")
        kind = str(match.lastgroup)
        if kind == "word":
            kind = "file" if "." in match[0] else "id"
        if kind != "blank":
            found.append(_Token(match[0] if kind == "mark" else kind, match[0], line, at - begin + 1))
        at = match.end()
        if kind == "nl":
            line, begin = line + 1, at
    return [*found, _Token("end", "", line, at - begin + 1)]


# --- Sentences of a file ---------------------------------------------------------------------------------------------


class _Names:
    """Names of one sort, with the lines where they are declared."""

    def __init__(self, sort: str) -> None:
        self.sort = sort
        self.lines: dict[str, int] = {}


class _Parser:
    """Reads the words from the first to the last."""

    def __init__(self, text: str, source: str) -> None:
        self._source = source
        self._lines = text.split("\n")
        self._inside, self._begun = "", 0
        self._agents, self._items, self._schemas = _Names("agent"), _Names("item"), _Names("schema")
        self._declared: list[ConfItem] = []
        self._lists: dict[str, dict[str, list[str]]] = {}
        self._assignments: list[Assignment] = []
        self._notes: list[str] = []
        self._tokens = _tokens(text, self)
        self._next = 0

    def file(self) -> Configuration:
        """The whole file."""
        sections = {"AGENTS": self._agent_list, "ITEM": self._item, "SCHEMA": self._schema, "ASSIGNMENT": self._assignment}
        while (token := self._take()).kind != "end":
            self._inside = ""
            if token.kind == "nl":
                continue
            if token.text not in sections:
                self.mistake(token, f"one of {', '.join(SECTIONS)}", near(token.text, SECTIONS))
            sections[token.text](token)
        self._note_unused()
        schemas = tuple(Schema(name, tuple(lists["shared"]), tuple(lists["local"])) for name, lists in self._lists.items())
        return Configuration(
            tuple(self._agents.lines),
            tuple(self._declared),
            schemas,
            tuple(self._assignments),
            tuple(self._notes),
            tuple(self._items.lines.values()),
        )

    def _agent_list(self, section: _Token) -> None:
        self._begin("AGENTS", section)
        self._expect("=", "'='")
        for token in self._ids("the name of an agent"):
            self._declare(self._agents, token)
        if self._peek().kind == ";":
            self._take()
        if self._peek().kind not in ("nl", "end"):
            self.mistake(self._peek(), "a line break behind the agents")

    def _item(self, section: _Token) -> None:
        token = self._id("the name of an item")
        self._declare(self._items, token)
        self._open(f"item {token.text}", section)
        fields: dict[str, str] = {}
        while (word := self._field("datatype", "headerfile", "period")) is not None:
            if word.text in fields:
                self.mistake(word, f"each field once, and {word.text!r} is there twice")
            self._expect("=", f"'=' behind {word.text}")
            fields[word.text] = self._value(word.text)
            if self._peek().kind == ";":
                self._take()
            elif self._peek().kind not in ("nl", "}"):
                self.mistake(self._peek(), f"';', a line break or '}}' behind {word.text}")
        if "datatype" not in fields:
            self.mistake(self._tokens[self._next - 1], "a field datatype before the '}'")
        kind = fields["datatype"]
        period = int(fields.get("period", "1"))
        self._declared.append(ConfItem(token.text, kind, fields.get("headerfile", f"{kind}.h"), period))

    def _value(self, field: str) -> str:
        if field == "datatype":
            return self._id("the name of a C type behind datatype").text
        token = self._take()
        if field == "headerfile":
            if token.kind != "file" or not _FILE.fullmatch(token.text):
                self.mistake(token, f'"headerfile" names a file NAME.h, not "{_shown(token)}"', plain=True)
            return token.text
        if token.kind == "id" and token.text not in KEYWORDS:
            self._notes.append(
                f"{self._source}:{token.line}:{token.column}: {self._inside}: period = {token.text} is no number: taken as 1"
            )
            return "1"
        if token.kind != "number" or not token.text.isdecimal() or not 1 <= int(token.text[:9]) <= PERIOD_MAX:
            self.mistake(token, f"a number of rounds from 1 to {PERIOD_MAX} behind period")
        return token.text

    def _schema(self, section: _Token) -> None:
        token = self._id("the name of a schema")
        self._schemas.lines.setdefault(token.text, token.line)
        lists = self._lists.setdefault(token.text, {"shared": [], "local": []})
        self._open(f"schema {token.text}", section)
        while (word := self._field("shared", "local")) is not None:
            self._expect("=", f"'=' behind {word.text}")
            for name in self._ids("the name of an item"):
                self._known(self._items, name)
                self._add(lists[word.text], name.text)
            if self._peek().kind == ";":
                self._take()
        if not lists["shared"] and not lists["local"]:
            self.mistake(self._tokens[self._next - 1], "a list shared or local before the '}'")
        for both in lists["shared"]:
            if both in lists["local"]:
                self._notes.append(f"{self._source}:{section.line}: schema {token.text} lists {both} in both; it is shared")

    def _assignment(self, section: _Token) -> None:
        self._open("assignment", section)
        schema, agents = "", list[str]()
        while (word := self._field("schema", "agents")) is not None:
            self._expect("=", f"'=' behind {word.text}")
            if word.text == "schema":
                if schema:
                    self.mistake(word, "one schema in an assignment, and this is a second")
                token = self._id("the name of a schema")
                self._known(self._schemas, token)
                schema = token.text
            else:
                for token in self._ids("the name of an agent"):
                    self._known(self._agents, token)
                    self._add(agents, token.text)
            if self._peek().kind == ";":
                self._take()
        if not schema or not agents:
            self.mistake(self._tokens[self._next - 1], f"a field {'agents' if schema else 'schema'} before the '}}'")
        self._assignments.append(Assignment(schema, tuple(agents)))

    def _note_unused(self) -> None:
        listed = {name for lists in self._lists.values() for names in lists.values() for name in names}
        for name, line in self._items.lines.items():
            if name not in listed:
                self._notes.append(f"{self._source}:{line}: item {name} is in no schema: no agent has it")
        assigned = {assignment.schema for assignment in self._assignments}
        for name, line in self._schemas.lines.items():
            if name not in assigned:
                self._notes.append(f"{self._source}:{line}: schema {name} is assigned to no agent")
        having = {agent for assignment in self._assignments for agent in assignment.agents}
        for name, line in self._agents.lines.items():
            if name not in having:
                self._notes.append(f"{self._source}:{line}: agent {name} is in no assignment: it has no items")

    # Parts of sentences

    def _begin(self, what: str, section: _Token) -> None:
        self._inside, self._begun = what, section.line

    def _open(self, what: str, section: _Token) -> None:
        self._begin(what, section)
        while self._peek().kind == "nl":
            self._take()
        self._expect("{", "'{'")

    def _field(self, *fields: str) -> _Token | None:
        """The next field's name; None at the closing brace."""
        while (token := self._take()).kind == "nl":
            pass
        if token.kind == "}":
            return None
        if token.text not in fields:
            self.mistake(token, f"{', '.join(fields)} or '}}'", near(token.text, fields))
        return token

    def _ids(self, what: str) -> list[_Token]:
        found = [self._id(what)]
        while self._peek().kind == ",":
            self._take()
            if self._peek().kind == "nl":
                self._take()
            found.append(self._id(what))
        return found

    def _id(self, what: str) -> _Token:
        token = self._take()
        if token.text in KEYWORDS:
            self.mistake(token, f"{what}; {token.text} is a keyword and names nothing")
        if token.kind != "id":
            self.mistake(token, what)
        return token

    def _expect(self, kind: str, what: str) -> None:
        token = self._take()
        if token.kind != kind:
            self.mistake(token, what)

    def _declare(self, names: _Names, token: _Token) -> None:
        if token.text in names.lines:
            first = names.lines[token.text]
            self.mistake(token, f"{names.sort} {token.text} is declared already, in line {first}", plain=True)
        names.lines[token.text] = token.line

    def _known(self, names: _Names, token: _Token) -> None:
        if token.text in names.lines:
            return
        cure = near(token.text, names.lines)
        if cure:
            meant = next(name for name in names.lines if repr(name) in cure)
            cure = f"; did you mean {meant!r} of line {names.lines[meant]}?"
        word = re.compile(rf"#.*\b{token.text}\b")
        hidden = [number for number, line in enumerate(self._lines[: token.line], 1) if word.search(line)]
        cure += f" (line {hidden[-1]} has it behind a '#')" if hidden else ""
        self.mistake(token, f"no {names.sort} {token.text} is declared above{cure}", plain=True)

    def _add(self, names: list[str], name: str) -> None:
        if name not in names:
            names.append(name)

    def _take(self) -> _Token:
        token = self._tokens[self._next]
        self._next = min(self._next + 1, len(self._tokens) - 1)
        return token

    def _peek(self) -> _Token:
        return self._tokens[self._next]

    def mistake(self, token: _Token, expected: str, cure: str = "", plain: bool = False) -> NoReturn:
        """Refuse the file at a word.

        Args:
            plain: ``expected`` is the whole sentence.

        Raises:
            FileMistakeError: always.
        """
        sentence = expected if plain else f"expected {expected}, found {_found(token)}{cure}"
        line = self._lines[token.line - 1].expandtabs(1).rstrip("\r")
        begin = max(0, token.column - 60)
        shown = "".join(letter if letter.isprintable() else "?" for letter in line[begin : begin + 120])
        caret = " " * (token.column - 1 - begin) + "^"
        begun = f" (begun in line {self._begun})" if token.line != self._begun else ""
        inside = f"{self._inside}{begun}: " if self._inside else ""
        raise FileMistakeError(f"{self._source}:{token.line}:{token.column}: {inside}{sentence}\n  {shown}\n  {caret}")


def _shown(token: _Token) -> str:
    return "".join(letter if letter.isprintable() else "?" for letter in token.text[:40]) or _SAID.get(token.kind, "")


def _found(token: _Token) -> str:
    return _SAID[token.kind] if token.kind in ("nl", "end") else repr(token.text[:40])
