"""The mappings of a process that stands still are asked for, not read: each later change of them is noticed."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from checkpoint.errors import ProcessGoneError
from checkpoint.linux.procfs import maps_reader, procfs
from checkpoint.linux.procfs.maps_reader import MapsReader

PAGES = 64

CHILD = """
import ctypes, os, sys
libc = ctypes.CDLL(None, use_errno=True)
libc.mmap.restype = ctypes.c_void_p
libc.mmap.argtypes = (ctypes.c_void_p, ctypes.c_size_t) + (ctypes.c_int,) * 3 + (ctypes.c_long,)
libc.mremap.restype = ctypes.c_void_p
libc.mremap.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_size_t, ctypes.c_int)
libc.munmap.argtypes = (ctypes.c_void_p, ctypes.c_size_t)
libc.mprotect.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
libc.prctl.argtypes = (ctypes.c_int, ctypes.c_ulong, ctypes.c_void_p, ctypes.c_ulong, ctypes.c_char_p)
one, other = (os.open(name, os.O_RDWR | os.O_CREAT) for name in ("one", "other"))
for file in (one, other):
    os.ftruncate(file, 1 << 20)
place = libc.mmap(None, int(sys.argv[1]) * 4096, 3, 0x22, -1, 0)
print("ready", flush=True)
for line in sys.stdin:
    found = eval(line)
    assert found not in (-1, 2**64 - 1), (line, ctypes.get_errno())
    print("done", flush=True)
"""


@dataclass
class Child:
    """A process that does with its mappings what it is told, and what we know of them."""

    process: subprocess.Popen[str]
    maps: MapsReader

    def order(self, words: str) -> None:
        """Have it evaluate this; ``place`` is 64 pages of its own, ``one`` and ``other`` are files."""
        assert self.process.stdin and self.process.stdout
        self.process.stdin.write(words + "\n")
        self.process.stdin.flush()
        assert self.process.stdout.readline() == "done\n"


@pytest.fixture
def child(tmp_path: Path) -> Iterator[Child]:
    """One whose mappings were read while it ran."""
    process = subprocess.Popen(
        [sys.executable, "-c", CHILD, str(PAGES)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=tmp_path
    )
    maps = MapsReader(process.pid)
    try:
        assert process.stdout and process.stdout.readline() == "ready\n"
        found = Child(process, maps)
        found.order("libc.mprotect(place + 5 * 4096, 4096, 1)")
        found.order("libc.mmap(place + 8 * 4096, 8192, 3, 0x11, one, 4096)")  # shared, of a file
        maps.refresh()
        maps.prepare()
        yield found
    finally:
        maps.close()
        process.kill()
        process.communicate()


def knows_the_question(pid: int) -> bool:
    """Whether this kernel answers it."""
    maps = MapsReader(pid)
    try:
        maps.refresh()
        maps.prepare()
        return maps._question is not None and maps._question.is_answered_as_expected()
    finally:
        maps.close()


def test_mappings_that_are_the_same_are_not_read_again(child: Child, monkeypatch: pytest.MonkeyPatch) -> None:
    if not knows_the_question(child.process.pid):
        pytest.skip("this kernel has no PROCMAP_QUERY (Linux 6.11)")
    read: list[str] = []

    def reading(genuine: Callable[[int, str], bytes]) -> Callable[[int, str], bytes]:
        def act(pid: int, name: str) -> bytes:
            read.append(name)
            return genuine(pid, name)

        return act

    monkeypatch.setattr(procfs, "read_bytes", reading(procfs.read_bytes))
    for _ in range(3):
        assert not child.maps.refresh_if_moved()
    assert not read
    child.order("libc.mprotect(place, 4096, 1)")
    assert child.maps.refresh_if_moved()
    assert read == ["maps"]


@pytest.mark.parametrize(
    "change",
    [
        "libc.munmap(place + 20 * 4096, 4096)",
        "libc.munmap(place, 64 * 4096)",
        "libc.mprotect(place + 5 * 4096, 4096, 3)",  # becomes one with its neighbours
        "libc.mprotect(place + 20 * 4096, 4096, 5)",
        "libc.mmap(None, 4096, 0, 0x22, -1, 0)",
        "libc.mmap(0x10000, 4096, 3, 0x100022, -1, 0)",  # below all others
        "libc.mmap(place + 8 * 4096, 8192, 3, 0x11, other, 4096)",
        "libc.mmap(place + 8 * 4096, 8192, 3, 0x11, one, 0)",
        "libc.mmap(place + 8 * 4096, 8192, 3, 0x12, one, 4096)",  # private
        "libc.mmap(place + 8 * 4096, 8192, 3, 0x32, -1, 0)",
        "libc.mremap(place + 40 * 4096, 4096, 3 * 4096, 1)",
        "libc.sbrk(4096)",
    ],
)
def test_every_change_of_the_mappings_is_noticed(child: Child, change: str) -> None:
    child.order(change)
    assert child.maps.refresh_if_moved()
    assert child.maps.lines == procfs.parse_maps(procfs.read_text(child.process.pid, "maps"))
    assert not child.maps.refresh_if_moved()


def test_a_name_is_read_with_the_next_text(child: Child) -> None:
    """A file that is removed stays mapped; what it is called by now is asked while the program runs."""
    child.order("os.unlink('one')")
    child.maps.refresh_if_moved()
    assert child.maps.refresh() or any(line.name.endswith("(deleted)") for line in child.maps.lines)
    assert [line.name[-14:] for line in child.maps.lines if line.name.endswith("(deleted)")] == ["/one (deleted)"]


def test_a_kernel_that_does_not_know_the_question_has_its_text_read(child: Child, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maps_reader, "PROCMAP_QUERY", 0xC0686610)
    child.maps._question = None
    child.maps.prepare()
    assert not child.maps.refresh_if_moved()
    assert child.maps._question is None
    child.maps.prepare()
    assert child.maps._question is None  # it is not asked again
    child.order("libc.munmap(place, 4096)")
    assert child.maps.refresh_if_moved()


def test_of_a_process_that_has_ended_it_is_said(child: Child) -> None:
    child.process.kill()
    child.process.wait()
    with pytest.raises(ProcessGoneError):
        child.maps.refresh_if_moved()
