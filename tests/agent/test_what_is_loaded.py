"""An agent without components is small: it loads modules for snapshots and users' requests only when these come."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

from checkpoint.runtime import slim_imports

LOADED: Final = """
import sys
from checkpoint.runtime import slim_imports as lean
lean.begin()
import {}
print(*(name for name, module in sys.modules.items() if vars(module or object).get("__spec__")))
"""


def loaded_by(*modules: str) -> set[str]:
    """The modules that a fresh interpreter has loaded which has imported these; what stands in for a module has no spec."""
    script = LOADED.format(", ".join(modules))
    return set(subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.split())


def seldom_used() -> set[str]:
    """What neither process needs; dataclasses ask inspect of every class from Python 3.12 on."""
    return set(slim_imports.SELDOM_USED) - ({"inspect"} if sys.version_info >= (3, 12) else set())


def test_the_main_loop_loads_neither_asyncio_nor_what_reads_pages() -> None:
    loaded = loaded_by("agent.main", "agent.main_loop.loop")
    assert "agent.main_loop.loop" in loaded
    assert not loaded & {
        "asyncio",
        "argparse",
        "json",
        "ssl",
        "numpy",
        "zmq",
        "importlib.metadata",
        "unicodedata",
        "_hashlib",
        *seldom_used(),
    }


@pytest.mark.parametrize("worker", ["agent.worker.process", "agent.worker.witness"])
def test_the_worker_loads_no_numpy_before_a_snapshot_comes(worker: str) -> None:
    loaded = loaded_by(worker)
    assert worker in loaded
    assert not loaded & {"numpy", "importlib.metadata", "ssl", "_ssl", "_hashlib", "unicodedata", *seldom_used()}
    assert not any(name.startswith(("failover.boards.", "failover.core.board.")) for name in loaded), "the team may have no board"


USED: Final = """
import sys, threading
from checkpoint.runtime import slim_imports as lean
lean.begin()
import inspect
assert type(sys.modules["inspect"]) is lean._Seldom
from dataclasses import dataclass
found = []
threads = [threading.Thread(target=lambda: found.append(inspect.isclass(int))) for _ in range(8)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
@dataclass
class Point:
    x: int
from inspect import signature
import textwrap as first, textwrap
print(found == [True] * 8, sys.modules["inspect"].__file__ == __import__("inspect").__file__, Point.__doc__, signature(Point))
print(first.dedent("  x"), first is textwrap, hasattr(inspect, "no such thing"), hasattr(first, "__file__"))
"""


def test_what_is_seldom_used_is_there_when_it_is_used_by_several_threads_at_once() -> None:
    ran = subprocess.run([sys.executable, "-c", USED], capture_output=True, text=True, check=True)
    assert ran.stdout.splitlines() == ["True True Point(x: int) (x: int) -> None", "x True False True"]


FROZEN: Final = """
import gc
import agent.worker.process

def main():
    print(gc.get_freeze_count() > len(gc.get_objects()), gc.isenabled())
    return 3
"""


def test_no_collection_of_the_worker_looks_at_what_it_has_loaded(tmp_path: Path) -> None:
    (tmp_path / "frozen.py").write_text(FROZEN)
    command = [sys.executable, "-P", "-m", "agent.system.child_main", "frozen"]
    ran = subprocess.run(command, env={**os.environ, "PYTHONPATH": str(tmp_path)}, capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stdout, ran.stderr) == (3, "True True\n", "")
