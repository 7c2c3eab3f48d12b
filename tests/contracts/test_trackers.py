"""The contract of `checkpoint.linux.memory.tracker.Tracker`, on every implementation that this kernel has.

A child of ours obeys one-letter orders about one mapping; we follow it from outside. It stands still at each look, because it
waits for the next order.
"""

from __future__ import annotations

import ctypes
import os
import random
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest

from checkpoint import arch
from checkpoint.linux import abi
from checkpoint.linux.memory import choose_tracker, pagemap, write_protect
from checkpoint.linux.memory.choose_tracker import SoftDirtyTracker
from checkpoint.linux.memory.digest_tracker import DigestTracker
from checkpoint.linux.memory.pagemap import PageScanner
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.memory.tracker import NONE, Scan, Tracker, extents_of
from checkpoint.linux.memory.write_protect import PagemapTracker
from checkpoint.linux.procfs.maps_reader import MapsReader
from checkpoint.linux.procfs.procfs import MapsLine
from checkpoint.pages import page_set

PAGE = abi.PAGE_SIZE
COUNT = 256
"""Pages of the child's mapping: more than what may be a page on the move (`pagemap.MARKER_RUN`)."""

CHILD = r"""
import ctypes, mmap, os, sys
libc = ctypes.CDLL(None, use_errno=True)
libc.mmap.restype = ctypes.c_void_p
libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_long]
for name in ("madvise", "mprotect"):
    getattr(libc, name).argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
libc.mremap.restype = ctypes.c_void_p
libc.mremap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_size_t, ctypes.c_int, ctypes.c_void_p]
libc.munmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t]
count, userfaultfd = map(int, sys.argv[1:])
PAGE = mmap.PAGESIZE
hole = libc.mmap(None, (count + 2) * PAGE, 0, 0x22, -1, 0)
place = hole + PAGE
def make():
    assert libc.mmap(place, count * PAGE, 3, 0x32, -1, 0) == place
    libc.madvise(place, count * PAGE, 15)  # MADV_NOHUGEPAGE
make()
faults = libc.syscall(userfaultfd, os.O_CLOEXEC | os.O_NONBLOCK | 1)
print(place, faults, flush=True)
for order in sys.stdin:
    verb, *numbers = order.split()
    first, size = [int(number) for number in numbers] + [1] * (2 - len(numbers))
    if verb == "write":
        for page in range(first, first + size):
            ctypes.memset(place + page * PAGE, 1 + (page + ctypes.string_at(place + page * PAGE)[0:1].__len__()) % 200, 64)
            value = int.from_bytes(ctypes.string_at(place + page * PAGE + 8, 8), "little") + 1
            ctypes.memmove(place + page * PAGE + 8, value.to_bytes(8, "little"), 8)
    elif verb == "forget":
        libc.madvise(place + first * PAGE, size * PAGE, 4)
    elif verb == "look":
        assert not any(ctypes.string_at(place + first * PAGE, size * PAGE))
    elif verb == "guard" and libc.madvise(place + first * PAGE, size * PAGE, 102):  # MADV_GUARD_INSTALL
        print("unknown", flush=True)
        continue
    elif verb == "again":
        libc.munmap(place, count * PAGE); make()
    elif verb == "replace":
        assert libc.mmap(place + first * PAGE, size * PAGE, 3, 0x32, -1, 0) == place + first * PAGE
    elif verb == "swap":
        away = libc.mmap(None, PAGE, 3, 0x22, -1, 0)
        for old, new in ((place + first * PAGE, away), (place + size * PAGE, place + first * PAGE), (away, place + size * PAGE)):
            assert libc.mremap(old, PAGE, PAGE, 3, new) == new
    elif verb in ("file", "closed"):
        mapped = {line.split()[-1] for line in open("/proc/self/maps") if " /" in line}
        large = max(filter(os.path.exists, mapped), key=os.path.getsize)
        file = os.open(large, os.O_RDONLY)
        assert os.fstat(file).st_size > count * PAGE
        assert libc.mmap(place, count * PAGE, 3 if verb == "file" else 0, 0x12, file, 0) == place
    elif verb == "short":
        file = os.memfd_create("short")
        os.ftruncate(file, first * PAGE)
        assert libc.mmap(place, count * PAGE, 3, 0x12, file, 0) == place
    elif verb == "seal":
        libc.mprotect(place, count * PAGE, 1)
    elif verb == "shut":
        libc.mprotect(place, count * PAGE, 0)
    elif verb == "open":
        libc.mprotect(place, count * PAGE, 3)
    print("done", flush=True)
"""


@dataclass
class Child:
    """The process that is followed, and our tracker on it."""

    process: subprocess.Popen[str]
    place: int
    tracker: Tracker
    maps: MapsReader

    def order(self, words: str) -> None:
        """Have it do one thing, and wait until it is done."""
        assert self.process.stdin and self.process.stdout
        self.process.stdin.write(words + "\n")
        self.process.stdin.flush()
        answer = self.process.stdout.readline()
        if answer == "unknown\n":
            pytest.skip(f"this kernel does not know: {words}")
        assert answer == "done\n"

    def scan(self) -> Scan:
        """Look, at its mapping alone."""
        changed = self.maps.refresh()
        return self.tracker.scan(self.lines(), changed=changed)

    def catch_up(self) -> Scan:
        """As `scan`, the way it is done while the process runs; skips the test where the tracker has no such way."""
        if not self.tracker.scans_running:
            pytest.skip(f"{self.tracker.name} does not scan a process that runs")
        changed = self.maps.refresh()
        return self.tracker.catch_up(self.lines(), changed=changed)

    def lines(self) -> list[MapsLine]:
        """The lines of its mapping."""
        return [line for line in self.maps.lines if self.place <= line.start < self.place + COUNT * PAGE]

    def numbers(self, found: page_set.Words) -> set[int]:
        """Which of its pages a set holds."""
        return {(address - self.place) // PAGE for address in page_set.addresses_of(found, PAGE).tolist()}


@pytest.fixture(params=["pagemap", "soft-dirty", "soft-dirty of an ordinary user", "digest"])
def child(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Child]:
    """A child with pages 0 to 9 written, followed from then on."""
    if request.param.endswith("user"):
        monkeypatch.setattr(pagemap, "zero_frame", lambda: 0)
    words = [sys.executable, "-c", CHILD, str(COUNT), str(arch.number_of("userfaultfd"))]
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    tracker: Tracker | None = None
    try:
        assert process.stdout
        place, faults = map(int, process.stdout.readline().split())
        tracker = _tracker(request.param, process.pid, faults)
        found = Child(process, place, tracker, MapsReader(process.pid))
        found.order("write 0 10")
        found.maps.refresh()
        tracker.arm(found.lines())
        found.scan()
        yield found
    finally:
        if tracker:
            tracker.close()
        process.kill()
        process.communicate()


def _tracker(kind: str, pid: int, faults: int) -> Tracker:
    if kind == "digest":
        return DigestTracker(pid)
    if kind.startswith("soft-dirty"):
        if not choose_tracker.has_soft_dirty():
            pytest.skip("this kernel has no soft-dirty bit (CONFIG_MEM_SOFT_DIRTY)")
        return SoftDirtyTracker(pid)
    if faults < 0:
        pytest.skip("this kernel gives no userfaultfd (vm.unprivileged_userfaultfd)")
    pidfd = os.pidfd_open(pid)
    try:
        ours = abi.pidfd_getfd(pidfd, faults)
        return PagemapTracker(pid, ours)
    except OSError as error:
        pytest.skip(f"this kernel has no asynchronous write protection: {error}")
    finally:
        os.close(pidfd)


def test_nothing_is_reported_while_nothing_is_written(child: Child) -> None:
    found = child.scan()
    assert not child.numbers(found.written) and not child.numbers(found.cleared)


def test_exactly_the_written_pages_are_reported_once(child: Child) -> None:
    child.order("write 3")
    child.order("write 5 2")
    assert child.numbers(child.scan().written) == {3, 5, 6}
    assert child.numbers(child.scan().written) == set()


def test_pages_that_did_not_exist_are_reported_when_they_come(child: Child) -> None:
    child.order("write 40 3")
    assert {40, 41, 42} <= child.numbers(child.scan().written)


def test_forgotten_pages_are_cleared_or_read_as_zeros(child: Child) -> None:
    child.order("forget 2 4")
    found = child.scan()
    told = child.numbers(found.written) | child.numbers(found.cleared)
    assert {2, 3, 4, 5} <= told
    content = Memory(child.process.pid).read(child.place + 2 * PAGE, 4 * PAGE)
    assert not any(content)


def test_forgotten_pages_that_are_read_again_are_cleared_or_read_as_zeros(child: Child) -> None:
    """The kernel shows its shared page of zeros there, as a page that nobody has written to."""
    child.order("forget 2 4")
    child.order("look 2 4")
    child.order("look 40 2")
    found = child.scan()
    assert {2, 3, 4, 5} <= child.numbers(found.written) | child.numbers(found.cleared)
    child.order("forget 40 2")
    child.order("write 41")
    assert 41 in child.numbers(child.scan().written)


def test_guards_are_told_and_do_not_exist(child: Child) -> None:
    child.order("guard 2 4")
    child.order("guard 100 90")
    found = child.scan()
    assert {2, 3, 4, 5} <= child.numbers(found.written) | child.numbers(found.cleared)
    assert child.numbers(child.tracker.existing(child.lines())) == {0, 1, 6, 7, 8, 9}


def test_guards_are_found_in_the_page_tables(child: Child) -> None:
    child.order("guard 2 4")
    child.order("guard 100 90")
    tables = PageScanner(child.process.pid)
    found = tables.guards(extents_of(child.lines()))
    tables.close()
    if not len(found):
        pytest.skip("this kernel does not tell guards (before Linux 6.15)")
    assert child.numbers(found) == {2, 3, 4, 5, *range(100, 190)}


def test_a_mapping_made_again_at_the_same_address_is_fresh(child: Child) -> None:
    child.order("again")
    child.order("write 4")
    child.order("write 4")  # otherwise it is the content that it had
    found = child.scan()
    assert 4 in child.numbers(found.written)
    gone = child.numbers(found.cleared) | child.numbers(found.written)
    assert set(range(10)) <= gone
    child.order("write 7")
    assert child.numbers(child.scan().written) == {7}


def test_a_page_that_is_sealed_after_the_write_is_reported(child: Child) -> None:
    child.order("seal")
    child.scan()
    child.order("open")
    child.order("write 1")
    child.order("seal")
    assert 1 in child.numbers(child.scan().written)


def test_existing_pages_are_those_with_content(child: Child) -> None:
    assert child.numbers(child.tracker.existing(child.lines())) == set(range(10))


def test_a_files_mapping_that_nobody_may_look_into_has_no_pages_until_it_is_opened(child: Child) -> None:
    child.order("closed")
    found = child.scan()
    assert child.numbers(found.written) == set()
    assert set(range(10)) <= child.numbers(found.cleared)
    assert child.numbers(child.scan().written) == set()
    child.order("open")
    child.order("write 4 2")
    assert {4, 5} <= child.numbers(child.scan().written)
    child.order("write 7")
    child.order("shut")
    assert 7 in child.numbers(child.scan().written)


# Scans of a process that runs


@pytest.mark.parametrize("are_there", [True, False])
def test_what_lies_behind_the_end_of_a_file_is_never_to_be_read(child: Child, are_there: bool) -> None:
    """Nobody can read it: the kernel has no page to give. A loader maps libraries so for a moment, to put other memory there."""
    if not child.tracker.scans_running:
        pytest.skip(f"{child.tracker.name} does not scan a process that runs")
    size = COUNT - 6
    child.order(f"short {size}")
    if are_there:
        child.order(f"look 0 {size}")
    told = [child.catch_up(), child.catch_up(), child.scan()]
    assert all(number < size for found in told for number in child.numbers(found.written))
    child.order("write 3 2")
    assert child.numbers(child.catch_up().written) == {3, 4}
    assert child.numbers(child.tracker.existing(child.lines())) >= {3, 4}
    child.order("write 5")
    assert child.numbers(child.scan().written) == {5}


def test_a_running_scan_reports_once_and_the_next_scan_only_what_came_later(child: Child) -> None:
    child.order("write 3 4")
    assert child.numbers(child.catch_up().written) == {3, 4, 5, 6}
    child.order("write 5")
    child.order("write 100")
    assert child.numbers(child.scan().written) == {5, 100}
    assert child.numbers(child.catch_up().written) == set()


def test_what_lies_between_two_fresh_mappings_is_told_as_little_as_before(child: Child) -> None:
    if not child.tracker.scans_running:
        pytest.skip(f"{child.tracker.name} does not scan a process that runs")
    child.catch_up()
    for place in (1, 6):
        child.order(f"replace {place} 1")
        child.order(f"write {place}")
    assert child.numbers(child.catch_up().written) == {1, 6}


def test_the_backlog_is_what_a_scan_would_find_and_takes_nothing_away(child: Child) -> None:
    if not child.tracker.scans_running:
        pytest.skip(f"{child.tracker.name} does not scan a process that runs")
    assert child.tracker.backlog(child.lines(), 50, changed=False) == 0
    child.order("write 3 4")
    assert child.tracker.backlog(child.lines(), 50, changed=False) == 4
    assert child.tracker.backlog(child.lines(), 2, changed=False) == 2
    assert child.numbers(child.scan().written) == {3, 4, 5, 6}


def test_pages_forgotten_after_a_running_scan_are_told_by_the_next(child: Child) -> None:
    child.order("write 2 4")
    assert child.numbers(child.catch_up().written) == {2, 3, 4, 5}
    child.order("forget 3 2")
    found = child.scan()
    assert {3, 4} <= child.numbers(found.written) | child.numbers(found.cleared)


def test_a_mapping_replaced_after_a_running_scan_is_fresh_to_the_next(child: Child) -> None:
    child.order("write 2 4")
    child.catch_up()
    child.order("again")
    child.order("write 4")
    found = child.scan()
    assert 4 in child.numbers(found.written)
    assert set(range(10)) <= child.numbers(found.cleared)


def test_pages_that_change_places_after_a_running_scan_are_told_by_the_next(child: Child) -> None:
    child.catch_up()
    child.order("swap 2 7")
    assert {2, 7} <= child.numbers(child.scan().written)


def test_a_running_scan_follows_a_mapping_that_was_replaced(child: Child) -> None:
    child.order("again")
    child.order("write 4 2")
    found = child.catch_up()
    assert {4, 5} <= child.numbers(found.written) and set(range(10)) <= child.numbers(found.cleared)
    child.order("write 5")
    assert child.numbers(child.scan().written) == {5}


@pytest.mark.parametrize("child", ["pagemap"], indirect=True)
def test_what_a_scan_that_broke_off_may_have_protected_is_told_by_the_next(child: Child, monkeypatch: pytest.MonkeyPatch) -> None:
    """A part of the mapping is replaced between the check of its registration and the scan: pages before it have been scanned."""
    child.order("write 3 4")
    scanned = PageScanner.written_where_protected

    def replaced_meanwhile(self: PageScanner, ranges: page_set.Words) -> tuple[page_set.Words, page_set.Words]:
        monkeypatch.undo()
        child.order("replace 200 10")
        _, refused = scanned(self, ranges)
        assert len(refused), "the kernel refuses a mapping that is not registered"
        return NONE, refused  # what was found before the kernel broke off is nothing that it promises to tell

    monkeypatch.setattr(PageScanner, "written_where_protected", replaced_meanwhile)
    told = child.numbers(child.catch_up().written)
    told |= child.numbers(child.scan().written)
    assert {3, 4, 5, 6} <= told
    child.order("write 8")
    child.scan()
    child.order("write 9")
    assert child.numbers(child.scan().written) == {9}


@pytest.mark.parametrize("child", ["pagemap"], indirect=True)
def test_what_is_written_while_newcomers_are_protected_is_told_by_the_next(child: Child, monkeypatch: pytest.MonkeyPatch) -> None:
    """A page written between the scan and the protection of windows around others is not protected along with them."""
    monkeypatch.setattr(write_protect, "WHOLE_WINDOW", PAGE)  # as if the mapping were too large to be protected whole
    monkeypatch.setattr(write_protect, "WINDOW", 16 * PAGE)
    tracker, first = child.tracker, -(child.place // PAGE) % 16
    child.order("forget 0 10")
    child.order(f"write {first + 20}")
    tracker.arm(child.lines())
    tracker.scan(child.lines(), changed=True)
    looked = PageScanner.existing

    def written_meanwhile(self: PageScanner, ranges: page_set.Words, *, own: bool = True) -> page_set.Words:
        monkeypatch.undo()
        monkeypatch.setattr(write_protect, "WHOLE_WINDOW", PAGE)
        monkeypatch.setattr(write_protect, "WINDOW", 16 * PAGE)
        child.order(f"write {first + 20}")
        return looked(self, ranges, own=own)

    child.order(f"write {first}")
    child.order(f"write {first + 32}")
    monkeypatch.setattr(PageScanner, "existing", written_meanwhile)
    assert {first, first + 32} <= child.numbers(tracker.catch_up(child.lines(), changed=False).written)
    assert first + 20 in child.numbers(tracker.scan(child.lines(), changed=False).written)


def test_large_mappings_are_protected_around_what_exists() -> None:
    line = MapsLine(0, 64 << 30, 3, False, 0, 0, 0, "")
    existing = np.array([[1 << 30, (1 << 30) + PAGE], [(1 << 30) + (4 << 20), (1 << 30) + (4 << 20) + PAGE]], dtype=np.uint64)
    windows = write_protect.windows_of(line, existing)
    assert page_set.total_size(windows) <= 4 * write_protect.WINDOW + write_protect.WINDOW
    assert not len(page_set.difference(existing, windows))


@pytest.mark.parametrize(("inode", "is_whole"), [(0, False), (7, True)])
def test_the_stack_of_a_thread_is_protected_around_what_exists_and_a_library_whole(inode: int, is_whole: bool) -> None:
    """Each hole that is protected takes a scan as long as a page; which pages of a file are copies takes longer to find."""
    line = MapsLine(8 << 20, 16 << 20, 3, False, 0, 0, inode, "")
    existing = np.array([[line.end - 2 * PAGE, line.end]], dtype=np.uint64)
    windows = write_protect.windows_of(line, existing)
    assert page_set.total_size(windows) == (line.size if is_whole else write_protect.WINDOW)


def test_the_scan_structure_is_as_the_kernel_has_it() -> None:
    assert ctypes.sizeof(abi.PageScan) == 96


@pytest.fixture
def copies(child: Child) -> Child:
    """The child, with a file mapped for itself, pages 0 to 9 of which it has written."""
    child.order("file")
    child.order("write 0 10")
    child.scan()
    child.tracker.confirm()
    child.scan()
    assert child.tracker.confirm()
    return child


def told(child: Child) -> Scan:
    """A scan, and the next one where it may have left something out."""
    first = child.scan()
    if child.tracker.confirm():
        return first
    then = child.scan()
    assert child.tracker.confirm()
    return Scan(page_set.union(first.written, then.written), page_set.union(first.cleared, then.cleared))


def test_a_private_copy_of_a_files_page_that_is_given_up_is_told(copies: Child) -> None:
    for page in (2, 7):
        copies.order(f"forget {page}")
        scan = told(copies)
        assert page in copies.numbers(scan.written) | copies.numbers(scan.cleared)
        assert not copies.numbers(told(copies).cleared)


def test_a_private_copy_that_is_given_up_and_made_anew_behind_the_scan_is_told(copies: Child) -> None:
    copies.order("forget 2")
    scan = copies.scan()
    copies.order("write 2")
    if copies.numbers(scan.written) | copies.numbers(scan.cleared):  # it has told already
        assert copies.numbers(copies.scan().written) == {2}
        return
    assert not copies.tracker.confirm()
    assert 2 in copies.numbers(copies.scan().written)
    assert copies.tracker.confirm()


def test_what_is_written_behind_every_scan_is_doubted_once(copies: Child) -> None:
    """The kernel tells that such a page is there; it could have gone before the scan, and come since."""
    confirmed = []
    for _ in range(6):
        copies.scan()
        copies.order("write 3 2")
        confirmed.append(copies.tracker.confirm())
        copies.scan()
        assert copies.tracker.confirm()
    assert confirmed.count(False) <= 1
    copies.order("forget 3")
    scan = copies.scan()
    assert 3 in copies.numbers(scan.written) | copies.numbers(scan.cleared)
    assert copies.tracker.confirm()


def test_whatever_is_written_and_given_up_is_told(copies: Child) -> None:
    if not copies.tracker.sees_every_write:
        pytest.skip(f"{copies.tracker.name} does not see what is changed back")
    dice = random.Random(5)
    state = dict.fromkeys(range(10), True)
    for _ in range(60):
        seen: set[int] = set()
        before = dict(state)
        for _ in range(dice.randrange(4)):
            page, writes = dice.randrange(10), dice.random() < 0.5
            copies.order(f"{'write' if writes else 'forget'} {page}")
            state[page] = writes
            seen.add(page)
        scan = told(copies)
        written, cleared = copies.numbers(scan.written), copies.numbers(scan.cleared)
        for page in seen:
            assert page in written if state[page] else page in cleared or page in written or not before[page]


def test_holes_are_not_filled_by_looking_at_them(child: Child, monkeypatch: pytest.MonkeyPatch) -> None:
    if not isinstance(child.tracker, PagemapTracker):
        pytest.skip(f"{child.tracker.name} has no holes that look like pages")
    asked: list[int] = []
    monkeypatch.setattr(Memory, "readable_pages", lambda _, extents: asked.append(len(extents)))
    child.order("again")
    for page in range(0, COUNT, 40):  # between them holes that are protected: a few, and many at a time
        child.order(f"write {page} 3")
    told(child)
    child.order("forget 80 30")
    told(child)
    assert not asked
