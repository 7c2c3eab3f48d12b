"""A keeper lives for weeks, and no collection may fall into a freeze: it looks for garbage itself, between requests."""

from __future__ import annotations

import subprocess
import sys

from checkpoint import channel, keeper
from checkpoint.channel import Channel, Reply

MAKES_GARBAGE = """
import os, sys, weakref
from checkpoint import keeper
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

keeper.engine.engine_named = lambda name: Tracer()
os._exit(keeper.main(["keeper", sys.argv[1]]))
"""


def test_what_holds_itself_is_found_after_some_requests() -> None:
    ours, theirs = channel.pair()
    command = [sys.executable, "-c", MAKES_GARBAGE, str(theirs.fileno())]
    with theirs:
        process = subprocess.Popen(
            command, pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True
        )
    link: Channel[Reply] = Channel(ours, Reply)
    try:
        for _ in range(keeper.COLLECTED_AFTER):
            link.send(channel.Probe(1))
            reply, _ = link.receive()
            assert isinstance(reply, channel.Failed)
    finally:
        link.close()
        told, _ = process.communicate()
    assert told == "collected\n" * keeper.COLLECTED_AFTER
    assert process.returncode == 0


HOLDS_ERRORS = """
import os, sys, weakref
from checkpoint import keeper
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

keeper.engine.engine_named = lambda name: Tracer()
os._exit(keeper.main(["keeper", sys.argv[1]]))
"""


def test_an_error_that_was_answered_holds_nothing() -> None:
    """A capture that fails has copied pages, and on a busy machine many fail before garbage is looked for."""
    ours, theirs = channel.pair()
    command = [sys.executable, "-c", HOLDS_ERRORS, str(theirs.fileno())]
    with theirs:
        process = subprocess.Popen(
            command, pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True
        )
    link: Channel[Reply] = Channel(ours, Reply)
    try:
        for _ in range(3):
            link.send(channel.Probe(1))
            reply, _ = link.receive()
            assert isinstance(reply, channel.Failed)
    finally:
        link.close()
        told, _ = process.communicate()
    assert told == "let go\n" * 3
    assert process.returncode == 0
