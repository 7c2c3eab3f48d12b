"""CAMBADA's pman.conf as declarations."""

from __future__ import annotations

import pytest

from failover.core.schedule import orders, pman_conf
from failover.core.schedule.course import Overrun
from failover.errors import ScheduleError

TICK_NS = 33_000_000
GOOD = """
vision 1 0 1 40
# a comment
agent   2 1   1  30
slow\t30 60 45 120  # more
"""


def test_each_line_is_a_task_in_ticks() -> None:
    vision, agent, slow = pman_conf.declarations(GOOD, TICK_NS)
    assert (vision.name, vision.terms.period_ns, vision.terms.phase_ns, vision.terms.deadline_ns) == (
        "vision",
        TICK_NS,
        0,
        TICK_NS,
    )
    assert (agent.terms.period_ns, agent.terms.phase_ns, agent.terms.priority) == (2 * TICK_NS, TICK_NS, 30)
    assert (slow.terms.phase_ns, slow.terms.priority, slow.terms.overrun) == (0, 99, Overrun.QUEUE)
    assert len(slow.notes) == 3  # of its priority, its phase, its deadline
    assert len(orders.added({}, [vision, agent, slow]).written) == 3


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("vision 1 0 1", "pman.conf:1: 4 words; a line has 5: name, period, phase, deadline, priority"),
        ("vision 1 0 1 40\n\nvision 2 0 1 40", "pman.conf:3: 'vision' stands in the file twice"),
        ("vision 1 0 soon 40", "pman.conf:1: deadline is 'soon': a number of ticks is expected"),
        ("vision 1 0 -1 40", "pman.conf:1: deadline is '-1': a number of ticks is expected"),
        ("vision 1 0 ² 40", "pman.conf:1: deadline is '²'"),
        ("vision 0 0 0 40", "pman.conf:1: cannot schedule 'vision': a period of 0 s"),
        (f"vision {'1' * 5_000} 0 0 40", f"pman.conf:1: period is '{'1' * 40}': a number of ticks is expected"),
        ("vision 1 0 0 " + "9" * 400, f"pman.conf:1: priority is '{'9' * 40}': a number of ticks is expected"),
        ("vis\udcffion 1 0 0 40", "pman.conf:1: cannot schedule 'vis\\udcffion': a name has 1 to 200 bytes of UTF-8"),
        (f"vision {10**12} 0 0 40", "pman.conf:1: cannot schedule 'vision': a period of"),
    ],
)
def test_a_mistake_is_named_with_its_line(text: str, said: str) -> None:
    with pytest.raises(ScheduleError) as refusal:
        pman_conf.declarations(text, TICK_NS)
    assert str(refusal.value).startswith(said)
