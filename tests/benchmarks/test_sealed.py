"""What the benchmark of sealed copies makes of what it saw, and of a program's memory."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from benchmarks import sealed
from benchmarks.figures import OURS
from benchmarks.running import running


def seen(*took: float) -> sealed._Seen:
    return sealed._Seen(list(took), list(took), list(took), [1.0], [20.0])


def test_ratios_are_of_one_turn_and_the_rest_is_of_all_turns() -> None:
    found = sealed._figures(
        "witness", {False: [seen(10, 20, 30), seen(100, 100, 100)], True: [seen(10, 40, 45), seen(50, 50, 110)]}
    )
    acknowledged = {one.who: one.values for one in found if one.benchmark == "until a delta is acknowledged"}
    assert acknowledged == {OURS: (10, 20, 30, 100, 100, 100), sealed.COPYING: (10, 40, 45, 50, 50, 110)}
    ratios = [one.values for one in found if one.unit == "×"]
    assert ratios == [(2.0, 0.5), (1.5, 1.1)] * 3


def test_a_dump_holds_the_programs_memory_of_which_a_megabyte_has_changed(tmp_path: Path) -> None:
    with running("mapping", 4, 1000, 1, 0, directory=tmp_path) as program:
        dumps = []
        for _ in range(2):
            os.kill(program.pid, signal.SIGSTOP)
            sealed._dump(program.pid, tmp_path / "memory")
            os.kill(program.pid, signal.SIGCONT)
            dumps.append((tmp_path / "memory").read_bytes())
            sealed._change(program)
    first, second = dumps
    pages = [first[at : at + 4096] != second[at : at + 4096] for at in range(0, len(first), 4096)]
    assert len(first) > 4_000_000 and 240 <= sum(pages) < 400, "and some of the interpreter's own"
