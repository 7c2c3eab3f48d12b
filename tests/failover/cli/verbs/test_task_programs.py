"""task run, task run-once, wait-activation: real commands at real instants."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import failover
from failover.boards import SCHEDULE_NAME
from failover.boards.schedule_file import ScheduleFile
from failover.cli import main
from failover.core.schedule import layout
from tests.failover.boards.conftest import place
from tests.failover.boards.programs import program
from tests.failover.cli.verbs.test_tasks import ODOMETRY

__all__ = ["place"]

ROOT = Path(__file__).parents[4]
FAILOVER = [sys.executable, "-m", "failover"]


def said(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str, str]:
    status = main.main(list(argv))
    out, err = capsys.readouterr()
    return status, out, err


def ended_of(place: Path, name: str) -> int:
    file = ScheduleFile.open(place / SCHEDULE_NAME)
    row = file.row_of(name)
    assert row is not None
    count = layout.read_live(file.table, row).counts.ended
    file.close()
    return count


def test_a_command_runs_once_after_its_predecessor_and_its_status_is_told(
    place: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with failover.scheduled("keep", period=1), program(ODOMETRY) as odometry:
        odometry.hear()
        status = main.main(["task", "run-once", "calibrate", "after=odometry", "--", "sh", "-c", "echo done; exit 7"])
        assert status == 7
        out, err = capfd.readouterr()
        assert out == "done\n" and "calibrate: sh ended with status 7 at activation 0" in err
        assert ended_of(place, "calibrate") == 1
        assert main.main(["task", "run-once", "calibrate", "--in-ms", "20", "--", "true"]) == 0
        assert ended_of(place, "calibrate") == 2


def test_a_command_runs_at_each_activation_until_the_task_is_removed(place: Path, tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    with failover.scheduled("keep", period=1):
        words = [*FAILOVER, "task", "run", "logger", "period_ms=20", "--", "sh", "-c", f"echo again > {fifo}"]
        with subprocess.Popen(words, cwd=ROOT) as process:
            for _ in range(3):
                assert "again" in fifo.read_text(), "once, or more often where this process is slow"
            assert ended_of(place, "logger") >= 2
            reading = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)  # no later echo waits for a reader
            assert main.main(["task", "remove", "logger"]) == 0
            assert process.wait() == 0
            os.close(reading)


def test_a_script_waits_for_its_activations(place: Path) -> None:
    script = "for turn in 1 2 3; do failover_ wait-activation || exit 9; done; exit 5"
    loop = f'failover_() {{ {sys.executable} -m failover "$@"; }}; {script}'
    with failover.scheduled("keep", period=1):
        words = [*FAILOVER, "task", "run", "--loop", "logger", "period_ms=20", "--", "sh", "-c", loop]
        done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 5, done.stderr
        ticks = [[int(word) for word in line.split()] for line in done.stdout.splitlines()]
        assert len(ticks) == 3
        for (number, due, late, _), (later, later_due, _, missed) in itertools.pairwise(ticks):
            assert later_due - due == (later - number) * 20_000_000 and late >= 0
            assert missed == later - number - 1
        assert ended_of(place, "logger") == 3


@pytest.mark.parametrize("name", ["KILL", "9", "SIGSTOP"])
def test_a_signal_that_no_program_can_take_wakes_none(capsys: pytest.CaptureFixture[str], name: str) -> None:
    with pytest.raises(SystemExit):
        main.main(["task", "run", "--signal", name, "logger", "period_ms=20", "--", "sleep", "9"])
    assert f"{name!r} ends or stops a program and wakes none" in capsys.readouterr().err


STOPS = """
#include <signal.h>
#include <stdio.h>
int main(void) {
    for (int turn = 0; turn < 4; turn++) {
        raise(SIGSTOP); /* waits for its next activation */
        printf("%d\\n", turn);
        fflush(stdout);
    }
    return 6;
}
"""


def test_a_c_program_that_stops_itself_is_woken_at_each_activation(place: Path, tmp_path: Path) -> None:
    (tmp_path / "stops.c").write_text(STOPS)
    subprocess.run(["gcc", "-Wall", "-Werror", "-o", tmp_path / "stops", tmp_path / "stops.c"], check=True)
    with failover.scheduled("keep", period=1):
        words = [*FAILOVER, "task", "run", "--signal", "CONT", "stops", "period_ms=20", "--", str(tmp_path / "stops")]
        done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout) == (6, "0\n1\n2\n3\n"), done.stderr
        assert ended_of(place, "stops") == 4


def test_a_script_that_stops_itself_is_woken_until_its_task_is_removed(place: Path, tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    with failover.scheduled("keep", period=1):
        script = f"while kill -STOP $$; do echo again > {fifo}; done"
        words = [*FAILOVER, "task", "run", "--signal", "CONT", "script", "period_ms=20", "--", "sh", "-c", script]
        with subprocess.Popen(words, cwd=ROOT) as process:
            for _ in range(3):
                assert "again" in fifo.read_text(), "once, or more often where this process is slow"
            assert ended_of(place, "script") >= 2, "an activation ends where the script stops again"
            reading = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)  # no later echo waits for a reader
            assert main.main(["task", "remove", "script"]) == 0
            assert process.wait() == 0
            os.close(reading)


def test_a_script_with_a_handler_gets_another_signal_once_it_has_the_handler(place: Path) -> None:
    script = "sleep 0.1; trap 'n=$((n+1)); echo $n' USR1; n=0; while [ $n -lt 3 ]; do sleep 0.005; done; exit 5"
    with failover.scheduled("keep", period=1):
        words = [*FAILOVER, "task", "run", "--signal", "USR1", "script", "period_ms=50", "--", "sh", "-c", script]
        done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 5, done.stderr
        assert done.stdout.split()[:3] == ["1", "2", "3"]


def test_a_program_that_ends_while_its_task_sleeps_ends_the_task(place: Path) -> None:
    loop = f"{sys.executable} -m failover wait-activation; {sys.executable} -m failover wait-activation & kill -9 $$"
    with failover.scheduled("keep", period=1):
        words = [*FAILOVER, "task", "run", "--loop", "logger", "period_ms=900000000", "phase_ms=800000000", "--", "sh", "-c"]
        assert subprocess.run([*words, "kill -9 $$"], cwd=ROOT, check=False).returncode == 128 + signal.SIGKILL
        words = [*FAILOVER, "task", "run", "--loop", "logger", "period_ms=20", "--", "sh", "-c"]
        done = subprocess.run([*words, loop], cwd=ROOT, check=False, capture_output=True)
        assert done.returncode == 128 + signal.SIGKILL


def test_sigterm_ends_task_and_command(place: Path, tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    with failover.scheduled("keep", period=1):
        words = [*FAILOVER, "task", "run", "logger", "period_ms=20", "--", "sh", "-c", f"echo $$ > {fifo}; exec sleep 1000"]
        with subprocess.Popen(words, cwd=ROOT) as process:
            inner = int(fifo.read_text())
            process.terminate()
            assert process.wait() == 128 + signal.SIGTERM
            with pytest.raises(ProcessLookupError):
                os.kill(inner, 0)


def test_sigterm_that_comes_while_a_command_starts_ends_it_too(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[subprocess.Popen[bytes]] = []

    def begin(command: list[str]) -> subprocess.Popen[bytes]:
        begun.append(start(command))
        os.kill(os.getpid(), signal.SIGTERM)
        return begun[-1]

    start = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", begin)
    with pytest.raises(SystemExit) as ended:
        main.main(["task", "run", "logger", "period_ms=20", "--", "sleep", "1000"])
    assert ended.value.code == 128 + signal.SIGTERM
    assert [process.poll() for process in begun] == [-signal.SIGTERM]


def test_mistakes_are_sentences(place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("FAILOVER_ACTIVATION_FD", raising=False)
    status, _, err = said(capsys, "wait-activation")
    assert status == 1 and "no task runs this program" in err and "task run --loop" in err
    status, _, err = said(capsys, "task", "run", "logger", "period_ms=20")
    assert status == 1 and "there is no command" in err
    status, _, err = said(capsys, "task", "run", "logger", "period_ms=20", "--", "/no/such/program")
    assert status == 1 and "cannot run /no/such/program: No such file or directory" in err
    status, _, err = said(capsys, "task", "run", "logger", "--", "true")
    assert status == 1 and "logger" in err
