"""Facts of /proc that are asked for in one go: the same as those that are read one by one, and as they are now."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from checkpoint.errors import CheckpointError, ProcessGoneError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.particulars import FILES, LINKS, Afresh, Particulars, Told

OBEYS = """
import os, resource, sys
print("ready", flush=True)
for line in sys.stdin:
    exec(line)
    print("done", flush=True)
"""


@contextmanager
def obeying(*arguments: str) -> Iterator[tuple[int, Callable[[str], None]]]:
    """A process that does what it is told, and its pid."""
    with subprocess.Popen(
        [sys.executable, "-c", OBEYS, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin and process.stdout
        assert process.stdout.readline() == "ready\n"

        def tell(statement: str) -> None:
            assert process.stdin and process.stdout
            print(statement, file=process.stdin, flush=True)
            assert process.stdout.readline() == "done\n"

        try:
            yield process.pid, tell
        finally:
            process.kill()


@contextmanager
def particulars(pid: int, *, keeps_files: bool = True) -> Iterator[Particulars]:
    made = Particulars(pid, keeps_files=keeps_files)
    try:
        yield made
    finally:
        made.close()


def everything(facts: Told) -> dict[str, object]:
    """Each answer, or the class of the error in its place."""
    told: dict[str, object] = {}
    for ask, names in ((facts.read, (*FILES, "auxv")), (facts.link, LINKS)):
        for name in names:
            try:
                told[name] = ask(name)
            except (CheckpointError, OSError) as error:
                told[name] = type(error)
    return told


@pytest.mark.parametrize("keeps_files", [True, False])
def test_the_answers_are_those_that_are_read_one_by_one(keeps_files: bool) -> None:
    with obeying("first", "") as (pid, _), particulars(pid, keeps_files=keeps_files) as facts:
        facts.ask()
        told = everything(facts)
        assert told == everything(Afresh(pid))
        assert str(told["exe"]).startswith("/")
        assert bytes(told["cmdline"]).endswith(b"first\0\0")  # type: ignore[call-overload]


@pytest.mark.parametrize("keeps_files", [True, False])
def test_what_has_changed_since_is_told_when_it_is_asked_again(keeps_files: bool, tmp_path: Path) -> None:
    place = tmp_path / "ä place"
    place.mkdir()
    with obeying() as (pid, tell), particulars(pid, keeps_files=keeps_files) as facts:
        facts.ask()
        before = facts.meaning("limits", procfs.parse_limits)
        assert facts.meaning("limits", procfs.parse_limits) is before, "its meaning is worked out once"
        tell(f"os.chdir({str(place)!r}); resource.setrlimit(resource.RLIMIT_CORE, (0, 4096))")
        facts.ask()
        assert facts.link("cwd") == str(place)
        assert facts.meaning("limits", procfs.parse_limits)[4] == (0, 4096)
        place.rmdir()
        facts.ask()
        assert facts.link("cwd") == f"{place}{procfs.DELETED}"


def test_what_it_executes_since_is_told() -> None:
    with obeying("first") as (pid, tell), particulars(pid) as facts:
        facts.ask()
        earlier = facts.read("auxv")
        then = "import time; print('done', flush=True); time.sleep(60)"
        tell(f"os.execv('/proc/self/exe', ['another', '-c', {then!r}])")
        facts.ask()
        assert (facts.read("cmdline"), facts.read("auxv")) == (procfs.read_bytes(pid, "cmdline"), procfs.read_bytes(pid, "auxv"))
        assert facts.read("cmdline").startswith(b"another\0")
        assert facts.read("auxv") != earlier, "its addresses are chosen anew"


def test_an_answer_that_is_longer_than_its_room_is_whole() -> None:
    with obeying("x" * FILES["cmdline"]) as (pid, _), particulars(pid) as facts:
        facts.ask()
        assert facts.read("cmdline") == procfs.read_bytes(pid, "cmdline")
        assert len(facts.read("cmdline")) > FILES["cmdline"]


@pytest.mark.parametrize("is_asked_before", [True, False])
def test_a_process_that_has_ended_is_gone(is_asked_before: bool) -> None:
    with contextlib.ExitStack() as ends:
        with obeying() as (pid, _):
            facts = ends.enter_context(particulars(pid))
            if is_asked_before:
                facts.ask()
        facts.ask()
        with pytest.raises(ProcessGoneError):
            facts.link("cwd")
        with pytest.raises(ProcessGoneError):
            facts.read("limits")


def test_descriptors_are_given_back() -> None:
    before = os.listdir("/proc/self/fd")
    with particulars(os.getpid()) as facts:
        facts.ask()
    assert os.listdir("/proc/self/fd") == before
