"""Alternatives to us for one image of a process: gcore and CRIU, called as their manuals say."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Protocol

from benchmarks.running import BenchmarkError

PATIENCE_S: Final = 60.0
LAST_LINES: Final = 2


class Alternative(Protocol):
    """Something that makes an image of a running process and lets it run on."""

    name: str

    def why_absent(self, directory: Path) -> str:
        """Why it cannot be measured here; "" when it can."""
        ...

    def snapshot(self, pid: int, directory: Path) -> None:
        """Write an image of the process into an empty directory; it runs on."""
        ...


class Gcore:
    """gdb's gcore(1): the whole memory as a core file, the program stopped all the while. Nothing restores one."""

    name = "gcore"

    def why_absent(self, directory: Path) -> str:
        """It comes with gdb."""
        return "" if shutil.which("gcore") else "not installed (Debian package gdb)"

    def snapshot(self, pid: int, directory: Path) -> None:
        """One core file."""
        call(["gcore", "-o", str(directory / "core"), str(pid)])


class Criu:
    """CRIU: the kernel's help, root, and a set of image files. Its incremental mode needs soft-dirty, which many kernels lack."""

    name = "CRIU"

    def why_absent(self, directory: Path) -> str:
        """The only honest probe: dump a small process and restore it."""
        if shutil.which("criu") is None:
            return "not installed (not in Debian 12 in a version that starts on kernels after 6.12)"
        if os.geteuid() != 0:
            return "needs root"
        with subprocess.Popen(
            ["sleep", "60"], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, start_new_session=True
        ) as child:
            try:
                self.snapshot(child.pid, directory)
            except BenchmarkError as error:
                return str(error)
            finally:
                child.kill()
        return ""

    def snapshot(self, pid: int, directory: Path) -> None:
        """Dump, leaving the program running."""
        self._dump(pid, directory, "--leave-running")

    def dump_and_kill(self, pid: int, directory: Path) -> None:
        """Dump a child of ours; it is gone afterwards."""
        self._dump(pid, directory)
        os.waitpid(pid, 0)

    def restore(self, directory: Path) -> None:
        """Restore as a child of ours, running; returns when it runs."""
        call([*self._command("restore"), "-D", str(directory), "--restore-detached", "--restore-sibling"])

    def _dump(self, pid: int, directory: Path, *more: str) -> None:
        call([*self._command("dump"), "-t", str(pid), "-D", str(directory), *more])

    def _command(self, verb: str) -> list[str]:
        return ["criu", verb, "-v1"]

    @staticmethod
    def version() -> str:
        """As it names itself."""
        return call(["criu", "--version"]).splitlines()[0].removeprefix("Version: ")


ALTERNATIVES: Final[tuple[Alternative, ...]] = (Gcore(), Criu())


def call(command: Sequence[str]) -> str:
    """Run a tool to its end; returns what it printed.

    Raises:
        BenchmarkError: it failed; with its last lines.
    """
    ran = subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace", timeout=PATIENCE_S, check=False
    )
    if ran.returncode:
        said = " / ".join((ran.stdout + ran.stderr).strip().splitlines()[-LAST_LINES:]) or "nothing"
        raise BenchmarkError(f"{command[0]} failed with status {ran.returncode}: {said}")
    return ran.stdout


def size_of(directory: Path) -> int:
    """Bytes that an image takes on the disk: holes are not counted."""
    return sum(path.stat().st_blocks * 512 for path in directory.rglob("*") if path.is_file())


def tell(text: str) -> None:
    """Tell the user that waits about progress."""
    print(f"  {text}", file=sys.stderr, flush=True)
