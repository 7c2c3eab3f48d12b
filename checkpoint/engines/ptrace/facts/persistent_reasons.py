"""Tell lasting refusal reasons from momentary ones: a process inside execve has hardly a mapping for a moment, and no vdso.

Source: begin_new_exec() in fs/exec.c; exec_mmap() comes before the program's own mappings and the vdso.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Final

LOOKS: Final = 10
PAUSE_S: Final = 0.02
"""Between two looks: a busy machine may keep a process from its processor in the middle of an execve(2)."""


def lasting(tell: Callable[[], Iterable[str]]) -> tuple[str, ...]:
    """The reasons that are told again and again; at once where there are none."""
    reasons = tuple(tell())
    for _ in range(LOOKS):
        if not reasons:
            break
        time.sleep(PAUSE_S)
        again = frozenset(tell())
        reasons = tuple(reason for reason in reasons if reason in again)
    return reasons
