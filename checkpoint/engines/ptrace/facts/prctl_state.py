"""Lasting prctl(2) settings of a process: the query of a capture reads them, the last calls of a restore set them again.

A setting is stored as the call that sets it: (option, second argument, third argument). A registration for membarrier(2) has the
same form, (`MEMBARRIER`, command, 0); kernels before 6.3 do not report it. Sources: prctl(2), linux/prctl.h, membarrier(2).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from checkpoint.errors import RestoreError
from checkpoint.linux import abi
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.linux.trace.syscall_batch import Answers, Batch

PR_GET_TSC: Final = 25
PR_SET_TSC: Final = 26
PR_TSC_ENABLE: Final = 1
PR_MCE_KILL: Final = 33
PR_MCE_KILL_GET: Final = 34
PR_MCE_KILL_SET: Final = 1
PR_MCE_KILL_DEFAULT: Final = 2
PR_GET_SPECULATION_CTRL: Final = 52
PR_SET_SPECULATION_CTRL: Final = 53
PR_SPEC_PRCTL: Final = 1
PR_SPEC_ENABLE: Final = 2
SPECULATIONS: Final = (0, 1, 2)
"""Store bypass, indirect branches, flush of the first-level cache."""
PR_SET_MDWE: Final = 65
PR_GET_MDWE: Final = 66
PR_SET_MEMORY_MERGE: Final = 67
PR_GET_MEMORY_MERGE: Final = 68
MEMBARRIER: Final = -1
"""No option of prctl(2): it stands for a call of membarrier(2)."""
GET_REGISTRATIONS: Final = 1 << 9

NAMES: Final = {
    PR_SET_TSC: "the switch of the time stamp counter",
    PR_MCE_KILL: "the policy for a broken page of memory",
    PR_SET_SPECULATION_CTRL: "a limit on speculation",
    PR_SET_MEMORY_MERGE: "the merging of equal pages",
    abi.PR_SET_THP_DISABLE: "where there are no transparent huge pages",
    MEMBARRIER: "a registration for memory barriers",
    PR_SET_MDWE: "that nothing written may become code",
}
"""Every switch that is kept, in the order in which they are set: the last one forbids what a restore itself does."""

OF_THREADS: Final = (PR_SET_TSC, PR_MCE_KILL, PR_SET_SPECULATION_CTRL)
"""Switches that each thread has for itself. A restore gives all threads the first one's."""

Switch = tuple[int, int, int]


class Questions:
    """The calls of one batch that ask for every switch. A kernel that does not know one has it off."""

    def __init__(self, batch: Batch) -> None:
        self._counter_word = batch.output(8)
        batch.add("prctl", PR_GET_TSC, self._counter_word, 0, 0, 0)
        self._broken = batch.add("prctl", PR_MCE_KILL_GET, 0, 0, 0, 0)
        self._speculation = [(which, batch.add("prctl", PR_GET_SPECULATION_CTRL, which, 0, 0, 0)) for which in SPECULATIONS]
        self._merge = batch.add("prctl", PR_GET_MEMORY_MERGE, 0, 0, 0, 0)
        self._sealed = batch.add("prctl", PR_GET_MDWE, 0, 0, 0, 0)
        self._barriers = batch.add("membarrier", GET_REGISTRATIONS, 0, 0)

    def read(self, answers: Answers) -> tuple[Switch, ...]:
        """The switches that do not stand as at a program's start."""
        results = answers.results
        found: list[Switch] = []
        counter = int.from_bytes(answers.at(self._counter_word, 4), "little")
        if counter > PR_TSC_ENABLE:
            found.append((PR_SET_TSC, counter, 0))
        if 0 <= results[self._broken] < PR_MCE_KILL_DEFAULT:
            found.append((PR_MCE_KILL, PR_MCE_KILL_SET, results[self._broken]))
        for which, place in self._speculation:
            chosen = results[place] & ~PR_SPEC_PRCTL
            if results[place] > 0 and results[place] & PR_SPEC_PRCTL and chosen != PR_SPEC_ENABLE:
                found.append((PR_SET_SPECULATION_CTRL, which, chosen))
        if results[self._merge] > 0:
            found.append((PR_SET_MEMORY_MERGE, results[self._merge], 0))
        if results[self._sealed] > 0:
            found.append((PR_SET_MDWE, results[self._sealed], 0))
        found += [(MEMBARRIER, 1 << bit, 0) for bit in range(32) if max(results[self._barriers], 0) >> bit & 1]
        return tuple(found)


def set_again(table: CallTable, switches: Iterable[Switch]) -> None:
    """Set them in a vessel: a note for each that this kernel or processor does not have.

    Raises:
        RestoreError: one that this version does not know.
    """
    order = list(NAMES)
    for option, second, third in sorted(switches, key=lambda switch: order.index(_known(switch))):
        lost = f"{NAMES[option]} is not kept"
        if option == MEMBARRIER:
            table.attempt(lost, "membarrier", second, 0, 0)
        else:
            table.attempt(lost, "prctl", option, second, third, 0, 0)


def _known(switch: Switch) -> int:
    option = switch[0]
    if option not in NAMES:
        raise RestoreError(
            f"cannot restore: it has switched prctl option {option}, unknown here; use the version that captured it"
        )
    return option
