"""One row of the capability table, which lists the kinds of state that a restore brings back.

A row describes one kind of thing that a program may hold. Each file of `checkpoint.resources` carries its own rows;
`checkpoint.engines.capability_table` collects them. ``./run table`` writes the table in docs/capabilities.md from these rows, and
tests compare the rows with the table and with every refusal in the code.
"""

from __future__ import annotations

from enum import StrEnum

from msgspec import Struct


class Verdict(StrEnum):
    """The result for a kind."""

    PRESERVED = "preserved"
    BY_RULE = "by rule"
    REFUSED = "refused"


class Area(StrEnum):
    """The area that a kind belongs to, in the order of the table."""

    PROCESS = "the process"
    THREADS = "threads"
    MEMORY = "memory"
    TIME = "clocks and timers"
    FILES = "files"
    PIPES = "pipes, events, watches"
    SOCKETS = "sockets"
    TERMINALS = "terminals"
    DEVICES = "devices"
    THERE = "at the other robot"


class Capability(Struct, frozen=True):
    """One row.

    Attributes:
        kind: its name, in a few words that a reader of the table would look for.
        sentence: how it comes back, by which rule, or what to do instead.
        said: a part of each sentence by which the code refuses or notes it, as it stands in the source: ``{}`` for each value
            that is filled in.
    """

    area: Area
    kind: str
    verdict: Verdict
    sentence: str
    said: tuple[str, ...] = ()


def preserved(area: Area, kind: str, sentence: str, *said: str) -> Capability:
    """A row about what comes back as it was."""
    return Capability(area, kind, Verdict.PRESERVED, sentence, said)


def by_rule(area: Area, kind: str, sentence: str, *said: str) -> Capability:
    """A row about what comes back where the operator's rules say how."""
    return Capability(area, kind, Verdict.BY_RULE, sentence, said)


def refused(area: Area, kind: str, sentence: str, *said: str) -> Capability:
    """A row about a thing that is refused by name, before the program is touched."""
    return Capability(area, kind, Verdict.REFUSED, sentence, said)
