"""Hooks alone: the signal that one names, and the remains of one that takes too long."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sys
import time
import tracemalloc
from pathlib import Path
from typing import Any

import pytest

from agent.hook_kinds import signal_in
from agent.worker.components import hooks
from agent.worker.components.hooks import STARTED, Hook, Hooks, Occasion

PATIENCE_S = 30.0
STUBBORN = """
import os, sys, time
if not (child := os.fork()):
    os.setpgid(0, 0)
    open(sys.argv[1], "w").write(str(os.getpid()))
time.sleep(1000)
"""
"""Its child is in a process group of its own."""


def test_a_signal_is_found_by_its_name() -> None:
    assert signal_in(("signal:SIGUSR2",)) == signal.SIGUSR2
    assert signal_in(("/bin/signal:SIGUSR2",)) == 0


@pytest.mark.parametrize("name", ["", "mro", "name", "__class__", "SIGKILL", "SIGSTOP", "SIGNONE", "12"])
def test_what_names_none_that_a_program_can_handle_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="names no signal"):
        signal_in((f"signal:{name}",))


def test_of_a_hook_that_takes_too_long_nothing_is_left_in_whichever_process_group(tmp_path: Path) -> None:
    note = tmp_path / "child"
    hook = Hook((sys.executable, "-S", "-c", STUBBORN, str(note)), 2.0)
    outcome = asyncio.run(Hooks().run("before_start", hook, Occasion("/lab/x", "robot1", 1, 64, STARTED)))
    child = int(note.read_text())
    try:
        assert "took longer than 2 s and was ended" in outcome.failure
        deadline = time.monotonic() + PATIENCE_S
        while is_alive(child):
            assert time.monotonic() < deadline, "its child lives on"
            time.sleep(0.01)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)


def test_of_a_hook_that_says_very_much_only_the_last_is_kept() -> None:
    says = "import sys\nfor _ in range(64):\n    sys.stdout.write('x' * 2**20)\nprint(); print('done')"
    tracemalloc.start()
    try:
        hook = Hook((sys.executable, "-S", "-c", says), PATIENCE_S)
        outcome = asyncio.run(Hooks().run("before_start", hook, Occasion("/lab/x", "robot1", 1, 64, STARTED)))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert (outcome.failure, outcome.last_line) == ("", "done")
    assert peak < 16 << 20


def is_alive(pid: int) -> bool:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    return False


def test_a_hook_that_leaves_a_process_behind_has_ended_all_the_same(tmp_path: Path) -> None:
    """As daemons do whose author forgot to close what they had been given."""
    note = tmp_path / "child"
    leaves = (
        "import os, sys, time\n"
        "if child := os.fork(): print('in the background', flush=True); sys.exit(0)\n"
        "open(sys.argv[1] + '.part', 'w').write(str(os.getpid())); os.rename(sys.argv[1] + '.part', sys.argv[1])\n"
        "time.sleep(1000)\n"
    )
    hook = Hook((sys.executable, "-S", "-c", leaves, str(note)), PATIENCE_S)
    outcome = asyncio.run(Hooks().run("before_start", hook, Occasion("/lab/x", "robot1", 1, 64, STARTED)))
    deadline = time.monotonic() + PATIENCE_S
    while not note.exists():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    child = int(note.read_text())
    try:
        assert (outcome.failure, outcome.last_line) == ("", "in the background")
        assert is_alive(child)
    finally:
        os.kill(child, signal.SIGKILL)


def test_how_long_its_output_stays_open_does_not_count_against_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hook that ends just in time and leaves a process behind was in time."""
    begin, limit_s = Hooks._begun, 1.0
    monkeypatch.setattr(hooks, "REST_S", 2 * limit_s)

    async def begun_and_over(*arguments: Any) -> Any:
        running = await begin(*arguments)
        await running.process.wait()
        return running

    monkeypatch.setattr(Hooks, "_begun", begun_and_over)
    hook = Hook(("/bin/sh", "-c", "sleep 1000 & echo $!"), limit_s)
    outcome = asyncio.run(Hooks().run("before_start", hook, Occasion("/lab/x", "robot1", 1, 64, STARTED)))
    assert outcome.failure == ""
    os.kill(int(outcome.last_line), signal.SIGKILL)


def test_systemd_puts_no_variable_into_the_words_of_a_hook(tmp_path: Path) -> None:
    """A shell that is one of its words would take a value for a part of its script."""
    starter, note = tmp_path / "systemd-run", tmp_path / "words"
    starter.write_text(f'#!/bin/sh\nprintf "%s\\n" "$@" >{note}\n')
    starter.chmod(0o700)
    hook = Hook(("/bin/sh", "-c", 'echo "${FAILOVER_COMPONENT}" $HOME'), 5.0)
    asyncio.run(Hooks(str(starter)).run("before_start", hook, Occasion("/lab/x", "robot1", 1, 64, STARTED)))
    words = note.read_text().splitlines()
    assert words[words.index("/bin/sh") :] == ["/bin/sh", "-c", 'echo "$${FAILOVER_COMPONENT}" $$HOME']
