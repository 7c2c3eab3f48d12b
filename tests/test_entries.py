"""Every command from its first instant: Ctrl-C while Python still loads it is no traceback."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from checkpoint.runtime import early_interrupt

BIN = Path(sys.executable).parent
IMPORTS = [sys.executable, "-X", "importtime"]
"""Says on standard error what has been imported, line by line."""

ENTRIES = {
    "failover": [*IMPORTS, str(BIN / "failover"), "status"],
    "failover-agent": [*IMPORTS, str(BIN / "failover-agent"), "--config", "/dev/null"],
    "python -m failover": [*IMPORTS, "-m", "failover", "status"],
    "python -m agent": [*IMPORTS, "-m", "agent", "--config", "/dev/null"],
    "python -m checkpoint": [*IMPORTS, "-m", "checkpoint", "keeper", "0"],
}


@pytest.mark.parametrize("later", [3, 20, 40])
@pytest.mark.parametrize("entry", ENTRIES)
def test_ctrl_c_while_a_command_loads_ends_it_quietly(entry: str, later: int) -> None:
    with subprocess.Popen(ENTRIES[entry], stderr=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True) as command:
        assert command.stderr is not None
        for line in command.stderr:
            if line.endswith(" checkpoint.runtime.early_interrupt\n"):
                break
        for _ in range(later):
            assert "import time:" in command.stderr.readline(), "still loading"
        command.send_signal(signal.SIGINT)
        rest = command.stderr.read()
    assert (command.returncode, "Traceback" in rest) == (early_interrupt.INTERRUPTED, False), rest[-2000:]


def test_an_interruption_that_was_to_be_ignored_stays_ignored() -> None:
    script = "from signal import *\nfrom checkpoint.runtime.early_interrupt import begin\nbegin()\nprint(getsignal(2) == SIG_IGN)"
    ran = subprocess.run(
        [sys.executable, "-c", script],
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
        capture_output=True,
        text=True,
        check=True,
    )
    assert ran.stdout == "True\n"


LEFT = """
import atexit, sys, threading
from checkpoint.runtime import early_interrupt as quiet
atexit.register(lambda: print("said goodbye"))
print("printed", end=" ")
if {threads}:
    threading.Thread(target=lambda: print("finished", end=" ")).start()
    threading.Thread(target=threading.Event().wait, args=(0.2,)).start()
sys.exit(quiet.left(7))
"""


@pytest.mark.parametrize("threads", [False, True])
def test_a_process_that_leaves_at_once_has_said_all_and_ended_all(threads: bool) -> None:
    ran = subprocess.run([sys.executable, "-E", "-c", LEFT.format(threads=threads)], capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stdout.split()) == (7, ["printed", *["finished"] * threads, "said", "goodbye"])


def test_what_cannot_be_written_at_the_end_is_an_error_as_ever() -> None:
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-E", "-c", LEFT.format(threads=False)]
        ran = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, check=False)
    assert ran.returncode == 120
    assert b"No space left on device" in ran.stderr


@pytest.mark.parametrize("closed", [(0,), (1,), (2,), (0, 1), (0, 1, 2)], ids=str)
def test_a_command_whose_streams_are_closed_does_what_it_was_told(closed: tuple[int, ...]) -> None:
    """Its keeper's channel would be taken for one of them otherwise."""
    streams = {0: "<&-", 1: ">&-", 2: "2>&-"}
    words = f"{sys.executable} -m failover check --table {' '.join(streams[number] for number in closed)}"
    ran = subprocess.run(words, shell=True, capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert ("threads" in ran.stdout) == (1 not in closed)


@pytest.mark.parametrize(
    ("words", "status"), [(["check", "--table"], 0), (["capture"], 2), (["restore", "/nowhere"], 1)], ids=str
)
def test_whoever_ignores_the_ends_of_children_can_start_commands(words: list[str], status: int) -> None:
    """Nobody can wait for the keeper then."""
    ran = subprocess.run(
        [sys.executable, "-m", "failover", *words],
        preexec_fn=lambda: signal.signal(signal.SIGCHLD, signal.SIG_IGN),
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ran.returncode, "Traceback" in ran.stderr, "child" in ran.stderr) == (status, False, False), ran.stderr


RUN = Path(__file__).parents[1] / "run"


@pytest.mark.parametrize("words", [["--help"], ["-h"], ["help"], ["setup", "--help"], ["table", "-h"]], ids=" ".join)
def test_run_explains_itself_when_it_is_asked(words: list[str]) -> None:
    ran = subprocess.run([RUN, *words], stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert all(f"./run {verb}" in ran.stdout for verb in ("demo", "test", "setup", "table", "fuzz", "audit"))


def test_run_tries_once_for_each_list_to_install_what_has_an_environment_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "venv").mkdir()
    python = tmp_path / "python"
    python.write_text(f"#!/bin/sh\necho tried >>{tmp_path}/tries\nexit 1\n")
    python.chmod(0o755)
    functions, _, _ = RUN.read_text().partition("\n# --- The commands")
    places = f"venv={tmp_path}/venv python={python} log={tmp_path}/log"

    def tries(do: str) -> int:
        ran = subprocess.run(
            ["sh", "-c", f"{functions}\n{places}\n{do}"], cwd=RUN.parent, capture_output=True, text=True, check=False
        )
        assert ran.returncode == 0, ran.stderr
        return (tmp_path / "tries").read_text().count("tried")

    own = "audit requirements-audit.txt why"
    assert [tries(do) for do in (f"make_own_once {own}", f"make_own_once {own}", f"make_own {own}")] == [1, 1, 2]
    assert tries("make_own_once s3-servers requirements-s3-servers.txt why") == 3, "another list is tried"
    (tmp_path / "venv/audit").mkdir()
    assert tries(f"cksum requirements-audit.txt >$venv/audit/made; make_own {own}") == 4, "its Python is missing"


@pytest.mark.parametrize(
    ("words", "mistake"),
    [([], "no command is given"), (["deom"], "there is no command deom"), (["setup", "--quick"], "setup takes no options")],
)
def test_run_names_a_mistake_and_does_nothing(words: list[str], mistake: str) -> None:
    ran = subprocess.run([RUN, *words], stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stdout) == (2, "")
    assert ran.stderr.startswith(f"run: {mistake}") and "./run test" in ran.stderr
