"""CAMBADA's table of periodic processes, pman.conf, as declarations of tasks; pure.

A line is one process: name, period, phase, deadline, priority, in ticks of its process manager, which counts frames of a camera.

Source: the process manager of CAMBADA (pman), as its programs read the file.
"""

from __future__ import annotations

from typing import Final

from failover.core.schedule.course import Overrun
from failover.core.schedule.terms import PRIORITY_MAX, Declaration, Terms, checked
from failover.errors import ScheduleError

WORDS: Final = ("name", "period", "phase", "deadline", "priority")


DIGITS_MAX: Final = 15
"""Of a number: more ticks are longer than any period that is possible."""


def declarations(text: str, tick_ns: int, where: str = "pman.conf") -> list[Declaration]:
    """The tasks of a file.

    Args:
        tick_ns: how long a tick lasts.
        where: the file's name, for messages.

    Raises:
        ScheduleError: a line is none of a process, or names one for the second time; names the line.
    """
    found: dict[str, Declaration] = {}
    for number, line in enumerate(text.splitlines(), 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        at = f"{where}:{number}"
        if len(words) != len(WORDS):
            raise ScheduleError(f"{at}: {len(words)} words; a line has {len(WORDS)}: {', '.join(WORDS)}")
        if words[0] in found:
            raise ScheduleError(f"{at}: {words[0]!r} stands in the file twice")
        try:
            found[words[0]] = checked(_declaration(words, tick_ns, at))
        except ScheduleError as error:
            raise error if str(error).startswith(at) else ScheduleError(f"{at}: {error}") from None
    return list(found.values())


def _declaration(words: list[str], tick_ns: int, at: str) -> Declaration:
    period, phase, deadline, priority = (_number(word, what, at) for word, what in zip(words[1:], WORDS[1:], strict=True))
    notes = []
    if priority > PRIORITY_MAX:
        notes.append(f"priority {priority} is taken as {PRIORITY_MAX}, the highest of SCHED_FIFO")
    terms = Terms(
        period_ns=period * tick_ns,
        phase_ns=phase * tick_ns,
        deadline_ns=deadline * tick_ns,
        priority=min(priority, PRIORITY_MAX),
        overrun=Overrun.QUEUE if deadline > period else Overrun.SKIP,
    )
    return Declaration(words[0], terms, notes=tuple(notes))


def _number(word: str, what: str, at: str) -> int:
    if not (word.isascii() and word.isdecimal() and len(word) <= DIGITS_MAX):
        raise ScheduleError(f"{at}: {what} is {word[:40]!r}: a number of ticks is expected")
    return int(word)
