"""Garbage collection of a keeper that lives for weeks: it collects between requests, so that none falls into a freeze."""

from __future__ import annotations

import subprocess
import sys

from checkpoint.keeper import messages, server
from checkpoint.keeper.messages import Channel, Reply

MAKES_GARBAGE = """
import os, sys, weakref
from checkpoint.keeper import server as keeper
from checkpoint.errors import ProbeError

class Held:
    pass

class Tracer:
    name = "ptrace"

    def probe(self, pid):
        one = Held()
        one.itself = one
        weakref.finalize(one, print, "collected", flush=True)
        raise ProbeError("it may not")

keeper.registry.engine_named = lambda name: Tracer()
os._exit(keeper.main(["keeper", sys.argv[1]]))
"""


HOLDS_ERRORS = """
import os, sys, weakref
from checkpoint.keeper import server as keeper
from checkpoint.errors import CaptureError, ProbeError

class Held:
    pass

def fails(held):
    explained = ProbeError("it may not")  # as whoever explains an error does: its own frame holds it
    try:
        raise CaptureError("it did not stop")
    except CaptureError as error:
        raise explained from error

class Tracer:
    name = "ptrace"

    def probe(self, pid):
        one = Held()
        weakref.finalize(one, os.write, 1, b"let go\\n")
        fails(one)

keeper.registry.engine_named = lambda name: Tracer()
os._exit(keeper.main(["keeper", sys.argv[1]]))
"""


def printed(script: str, requests: int) -> str:
    """What a keeper with such an engine writes while so many requests fail."""
    ours, theirs = messages.pair()
    command = [sys.executable, "-c", script, str(theirs.fileno())]
    with theirs:
        process = subprocess.Popen(
            command, pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True
        )
    link: Channel[Reply] = Channel(ours, Reply)
    try:
        for _ in range(requests):
            link.send(messages.Probe(1))
            reply, _ = link.receive()
            assert isinstance(reply, messages.Failed)
    finally:
        link.close()
        told, _ = process.communicate()
    assert process.returncode == 0
    return told


def test_what_holds_itself_is_found_after_some_requests() -> None:
    assert printed(MAKES_GARBAGE, server.COLLECTED_AFTER) == "collected\n" * server.COLLECTED_AFTER


def test_an_error_that_was_answered_holds_nothing() -> None:
    """A capture that fails has copied pages, and on a busy machine many fail before garbage is looked for."""
    assert printed(HOLDS_ERRORS, 3) == "let go\n" * 3
