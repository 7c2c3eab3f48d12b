"""Whether all tasks meet their deadlines: response times under fixed priorities, in the order of deadlines. Pure.

Tasks that share exactly one processor get the exact answer for the worst instant, at which all are due together. Phases can only
make it better; waiting for a predecessor is not in it. Tasks on several processors are judged by their load alone.

Source: N. C. Audsley, A. Burns, M. F. Richardson, K. W. Tindell, A. J. Wellings (1993); for deadlines beyond the period
K. W. Tindell, A. Burns, A. J. Wellings (1994).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from msgspec import Struct

from failover.core.schedule.terms import Kind, Terms

FULL: Final = 0.9
"""A higher load is told: nothing is left for other programs."""
TURNS_MAX: Final = 10_000
"""Of one response time: periods that differ by so much are no schedule of one processor."""
_NS: Final = 1e9


class Load(Struct, frozen=True):
    """What is asked of a set of processors.

    Attributes:
        cpus: bit i: processor i; 0: all.
        share: of these processors, by budgets and periods; 1: all of them.
        responses: task → nanoseconds from due to ended, at the worst; None: it has no bound. Only of one processor.
        late: tasks that may miss their deadline.
        unknown: tasks without a budget.
    """

    cpus: int
    share: float
    responses: dict[str, int | None]
    late: tuple[str, ...]
    unknown: tuple[str, ...]

    @property
    def fits(self) -> bool:
        """Whether the schedule is to be accepted."""
        return self.share <= 1 and not self.late

    def sentence(self) -> str:
        """What a person is told of it; "" if all is well."""
        where = _where(self.cpus)
        if self.share > 1:
            return (
                f"the tasks {where} need {self.share:.0%} of it: fewer, slower or shorter ones; --force takes them nevertheless"
            )
        if self.late:
            response = self.responses.get(self.late[0])
            told = "for ever" if response is None else f"{response / _NS:g} s"
            return f"{self.late[0]} may take {told} {where}, longer than its deadline; --force takes it nevertheless"
        if self.share > FULL:
            return f"the tasks {where} need {self.share:.0%} of it: little is left for other programs"
        return ""


def _where(cpus: int) -> str:
    places = [str(index) for index in range(cpus.bit_length()) if cpus >> index & 1]
    return f"on processor {', '.join(places)}" if places else "on all processors"


def by_deadline(tasks: Mapping[str, Terms]) -> list[str]:
    """The tasks, most urgent first: the shorter deadline, then the shorter period, then the name.

    Those without a deadline come last.
    """
    return sorted(tasks, key=lambda name: (not tasks[name].deadline_ns, tasks[name].deadline_ns, tasks[name].period_ns, name))


def priorities(tasks: Mapping[str, Terms], highest: int, lowest: int = 1) -> dict[str, int]:
    """Task → priority of SCHED_FIFO: its own if it has one, else by the order of deadlines.

    Where there are more tasks than priorities, the least urgent ones share the lowest.
    """
    free = [name for name in by_deadline(tasks) if not tasks[name].priority]
    given = {name: terms.priority for name, terms in tasks.items() if terms.priority}
    return given | {name: max(highest - place, lowest) for place, name in enumerate(free)}


def admission(tasks: Mapping[str, Terms], learned_ns: Mapping[str, int], cpus: int) -> list[Load]:
    """The load of each set of processors.

    Args:
        learned_ns: task → p99 of its durations, for those without a budget.
        cpus: how many processors the machine has.
    """
    sets: dict[int, list[str]] = {}
    for name in by_deadline(tasks):
        sets.setdefault(tasks[name].cpus, []).append(name)
    return [_load(mask, names, tasks, learned_ns, mask.bit_count() or cpus) for mask, names in sets.items()]


def _load(mask: int, names: Sequence[str], tasks: Mapping[str, Terms], learned_ns: Mapping[str, int], width: int) -> Load:
    budgets = {name: tasks[name].budget_ns or learned_ns.get(name, 0) for name in names}
    known = [name for name in names if budgets[name] and _distance_ns(tasks[name])]
    share = sum(budgets[name] / _distance_ns(tasks[name]) for name in known) / width
    ranks = priorities({name: tasks[name] for name in known}, len(known) + 1)
    order = sorted(known, key=lambda name: -ranks[name])
    responses: dict[str, int | None] = {}
    if width == 1:
        for place, name in enumerate(order):
            above = [(budgets[one], _distance_ns(tasks[one])) for one in order[:place]]
            responses[name] = response_ns(budgets[name], _distance_ns(tasks[name]), above)
    late = tuple(name for name, took in responses.items() if _is_late(took, tasks[name].deadline_ns))
    return Load(mask, share, responses, late, tuple(name for name in names if name not in known))


def _is_late(response: int | None, deadline_ns: int) -> bool:
    return bool(deadline_ns) and (response is None or response > deadline_ns)


def _distance_ns(terms: Terms) -> int:
    """The least time between two activations; 0: there is no such."""
    return terms.distance_ns if terms.kind is Kind.SPORADIC else terms.period_ns


def response_ns(budget_ns: int, period_ns: int, above: Sequence[tuple[int, int]]) -> int | None:
    """The longest time from due to ended on one processor; None: it has no bound.

    Args:
        above: budget and period of each task of a higher priority.
    """
    if budget_ns / period_ns + sum(budget / period for budget, period in above) > 1:
        return None
    worst, number, turns = 0, 0, 0
    while True:  # over the activations of one busy stretch
        busy_ns = (number + 1) * budget_ns
        while (longer := (number + 1) * budget_ns + sum(-(-busy_ns // period) * budget for budget, period in above)) != busy_ns:
            busy_ns = longer
            turns += 1
            if turns > TURNS_MAX:
                return None
        worst = max(worst, busy_ns - number * period_ns)
        number += 1
        turns += 1
        if busy_ns <= number * period_ns:
            return worst
        if turns > TURNS_MAX:
            return None
