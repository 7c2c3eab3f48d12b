"""numpy is loaded without the parts that we never use, and is numpy all the same."""

from __future__ import annotations

import subprocess
import sys
from typing import Final

import pytest

LOADED: Final = """
import os, sys
from checkpoint.runtime import slim_imports as lean
lean.begin()
lean.load_numpy()
import numpy as np
"""


def told(script: str, **variables: str) -> str:
    """What a fresh interpreter prints that has loaded numpy so."""
    ran = subprocess.run([sys.executable, "-c", LOADED + script], capture_output=True, text=True, check=True, env=variables)
    return ran.stdout.strip()


def test_neither_types_nor_texts_nor_threads_come_with_it() -> None:
    names = "(lean.NUMPYS_TYPES, *lean.NUMPYS_TEXTS)"
    assert told(f"print(*(name in sys.modules for name in {names}), len(os.listdir('/proc/self/task')))") == "False False False 1"


@pytest.mark.parametrize("found", [{}, {"OPENBLAS_NUM_THREADS": "3"}])
def test_the_environment_is_as_before(found: dict[str, str]) -> None:
    assert told("print(os.environ.get('OPENBLAS_NUM_THREADS'))", **found) == found.get("OPENBLAS_NUM_THREADS", "None")


@pytest.mark.parametrize(
    ("asked", "answer"),
    [
        ("np.linalg.det(np.eye(3))", "1.0"),
        ("np.matmul(np.ones((2, 3)), np.ones((3, 4))).sum()", "24.0"),
        ("np.unique(np.array([3, 1, 3], np.uint64)).tolist()", "[1, 3]"),
        ("np.ma.masked_array([1, 2], [True, False]).sum()", "2"),
        ("int(np.random.default_rng(1).integers(1, 2))", "1"),
        ("np.float64(1.5).is_integer()", "False"),
    ],
)
def test_it_works(asked: str, answer: str) -> None:
    assert told(f"print({asked})") == answer


def test_who_wants_its_types_later_finds_them() -> None:
    assert told("from numpy.typing import NDArray\nprint(NDArray[np.int8])").endswith("numpy.dtype[numpy.int8]]")


def test_who_wants_to_read_a_docstring_cleaned_can() -> None:
    assert told("import inspect\nprint(repr(inspect.cleandoc('a\\n    b')))") == r"'a\nb'"


def test_loading_it_twice_changes_nothing() -> None:
    assert told("before = set(sys.modules)\nlean.load_numpy()\nprint(before == set(sys.modules))") == "True"


def test_a_keeper_has_loaded_what_it_needs_and_no_more() -> None:
    modules = "checkpoint.keeper.server, checkpoint.engines.ptrace.engine"
    script = f"import {modules}\nprint(*(name for name, module in sys.modules.items() if module))"
    loaded = set(told(script).split())
    assert "checkpoint.engines.ptrace.capture.session" in loaded
    assert not loaded & {"numpy.typing", "numpy._typing", "numpy.ma", "ssl", "_hashlib", "typing_extensions", "asyncio"}
