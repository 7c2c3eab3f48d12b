"""Families of processes in three lives: what their programs begin with, and their way through captures and restores."""

from __future__ import annotations

import sys
from pathlib import Path

from tests.checkpoint.engines.ptrace.capture.test_trees import three_lives
from tests.checkpoint.round_trip import (
    Program,
    ended,
    expect_ok,
    start,
)

PREAMBLE = """
import os, signal, struct, sys, time
from pathlib import Path

def born(act):
    child = os.fork()
    if child == 0:
        os._exit(act() or 0)
    return child

def wait_for_go():
    while not Path("go").exists():
        time.sleep(0.01)

def expect(what, found, wanted):
    if found != wanted:
        print(f"{what}: {found!r} instead of {wanted!r}", flush=True)
        os._exit(1)

def expect_child(child):
    expect("the child", os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), 0)

def is_ready():
    print("ready", flush=True)
    wait_for_go()
"""


def goes_through_three_lives(program: str, directory: Path, *arguments: str) -> None:
    """It says what differs afterwards."""
    begun = start([sys.executable, "-c", PREAMBLE + program, *arguments], directory, isolate=True)

    def is_ready(one: Program) -> bool:
        return "ready\n" in one.output

    last, _ = three_lives(begun, is_ready)
    with ended(last):
        last.tell()
        expect_ok(last)
