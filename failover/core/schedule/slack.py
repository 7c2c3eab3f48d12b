"""The time between two activations, in which a snapshot costs a control loop nothing. Pure."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from msgspec import Struct

MARGIN_NS: Final = 200_000
"""From the end of a freeze to the next activation: a thawed thread is not at once on its processor."""


class Window(Struct, frozen=True):
    """When a component's tasks may be frozen.

    Attributes:
        begin_ns: the last of them has ended.
        end_ns: the first of them is due, less the margin; None: none of them is due again.
    """

    begin_ns: int
    end_ns: int | None

    def holds(self, now_ns: int, freeze_ns: int) -> bool:
        """Whether a freeze that begins now ends in it."""
        return now_ns >= self.begin_ns and (self.end_ns is None or now_ns + freeze_ns <= self.end_ns)


def window(tasks: Iterable[tuple[bool, int, int | None]], margin_ns: int = MARGIN_NS) -> Window | None:
    """The window of one component.

    Args:
        tasks: of each of its tasks, whether an activation is under way, when its last one ended, and when its next one is due
            (None: it is not known).

    Returns:
        None while an activation is under way.
    """
    seen = list(tasks)
    if any(is_running for is_running, _, _ in seen):
        return None
    dues = [due_ns for _, _, due_ns in seen if due_ns is not None]
    begin_ns = max((ended_ns for _, ended_ns, _ in seen), default=0)
    return Window(begin_ns, min(dues) - margin_ns if dues else None)
