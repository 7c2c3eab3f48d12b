"""A keeper that waits for its peer is woken when a child ends, at any instant, whichever of its threads gets the signal."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from checkpoint.keeper import messages
from checkpoint.keeper.messages import Channel, Reply
from checkpoint.linux import signal_wakeup
from tests.checkpoint.keeper.test_keeper_death import Keeper, answer_at_last
from tests.checkpoint.round_trip import ended, start

THREADS = """
import threading
for _ in range(6):
    threading.Thread(target=threading.Event().wait, daemon=True).start()
print("ready", flush=True)
threading.Event().wait()
"""

DEAF = """
import signal, sys, threading
from checkpoint.keeper import server as keeper
threading.Thread(target=threading.Event().wait, daemon=True).start()
signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGCHLD})  # the kernel tells the other thread, as it may at any time
sys.exit(keeper.main(["keeper", sys.argv[1]]))
"""


class DeafKeeper(Keeper):
    """One whose first thread is never interrupted by the news of a death."""

    def __init__(self) -> None:
        ours, theirs = messages.pair()
        with theirs:
            command = [sys.executable, "-c", DEAF, str(theirs.fileno())]
            self.process = subprocess.Popen(command, pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL)
        self.link: Channel[Reply] = Channel(ours, Reply)


@pytest.mark.parametrize("kind", [Keeper, DeafKeeper])
def test_a_program_that_is_killed_while_its_keeper_holds_it_ends(tmp_path: Path, kind: type[Keeper]) -> None:
    """Its threads end for their tracer first; until that has taken note of the last of them its parent hears nothing."""
    with ended(start([sys.executable, "-c", THREADS], tmp_path)) as program:
        program.wait_for_line("ready")
        keeper = kind()
        try:
            answer_at_last(keeper, messages.Protect(program.pid, "/test/threads"), messages.Protected)
            _, descriptors = answer_at_last(keeper, messages.Capture(True, 1, 1, hold=True), messages.Captured)
            messages.close_all(descriptors)
            os.kill(program.pid, signal.SIGKILL)
            assert program.finish() == -signal.SIGKILL
        finally:
            keeper.end()


def test_a_signal_that_another_thread_gets_is_heard_at_once() -> None:
    heard = threading.Event()
    reading, writing = os.pipe()
    before = signal.signal(signal.SIGUSR1, lambda *_: heard.set())
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR1})
    try:

        def other() -> None:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGUSR1})
            os.kill(os.getpid(), signal.SIGUSR1)
            if heard.wait(60):
                os.write(writing, b"x")
            os.close(writing)

        thread = threading.Thread(target=other)
        with signal_wakeup.waking() as await_readable:
            thread.start()
            await_readable(reading)
        thread.join()
        assert os.read(reading, 1) == b"x", "nobody heard it"
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGUSR1})
        signal.signal(signal.SIGUSR1, before)
        os.close(reading)


def test_another_thread_may_wait_too() -> None:
    reading, writing = os.pipe()

    def waits() -> None:
        with signal_wakeup.waking() as await_readable:
            await_readable(reading)

    thread = threading.Thread(target=waits)
    thread.start()
    os.close(writing)
    thread.join(60)
    assert not thread.is_alive()
    os.close(reading)
