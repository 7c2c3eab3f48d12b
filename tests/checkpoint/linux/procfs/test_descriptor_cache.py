"""The open descriptors of a program are reported as they are now, however much an earlier look had found."""

from __future__ import annotations

import contextlib
import operator
import os
import select
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec.structs
import pytest

from checkpoint.linux.procfs import descriptor, descriptors
from checkpoint.linux.procfs.descriptor import Descriptor
from checkpoint.linux.procfs.descriptor_cache import TEXTS_KEPT, KeptTexts
from checkpoint.resources import descriptor_groups
from checkpoint.resources.open_file import OpenFile
from checkpoint.resources.socket_cache import Recollection
from checkpoint.resources.survey import Kept, gather, with_contents


@contextlib.contextmanager
def kept() -> Iterator[KeptTexts]:
    """Of ourselves."""
    texts = KeptTexts(os.getpid())
    try:
        yield texts
    finally:
        texts.close()


def told(number: int, texts: KeptTexts | None) -> Descriptor:
    """What is said of one of ours."""
    (found,) = (one for one in descriptors.descriptors(os.getpid(), texts) if one.number == number)
    return found


class Program:
    """One that does to its descriptors what it is told."""

    def __init__(self) -> None:
        body = "import os, sys\nprint(flush=True)\nfor line in sys.stdin:\n    exec(line)\n    print(flush=True)"
        self._process = subprocess.Popen([sys.executable, "-c", body], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.pid = self._process.pid
        self._await()

    def _await(self) -> None:
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "\n"

    def do(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()
        self._await()

    def end(self) -> None:
        self._process.kill()
        self._process.communicate()


CHANGES_OF_SOME = {
    "one more": ("os.dup2(0, 60)", True),
    "one less": ("os.close(50)", True),
    "one closed and another opened": ("os.close(50); os.dup2(0, 49)", True),
    "another under the same number": ("os.dup2(0, 50)", False),
    "another offset": ("os.lseek(50, 7, os.SEEK_SET)", False),
    "close-on-exec": ("os.set_inheritable(50, False)", False),
    "nothing": ("pass", False),
}


@pytest.mark.parametrize("counts", [True, False], ids=["counted by the kernel", "listed"])
@pytest.mark.parametrize("change", CHANGES_OF_SOME)
def test_descriptors_are_listed_only_where_their_number_has_changed_or_one_has_gone(
    change: str, counts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    program, texts, listed = Program(), None, []
    try:
        program.do("os.dup2(os.open('/etc/passwd', os.O_RDONLY), 50); os.dup2(50, 51); os.dup2(1, 52)")
        texts = KeptTexts(program.pid)
        if not counts or not texts._count():
            counts = False
            monkeypatch.setattr(KeptTexts, "_count", lambda texts: 0)
        for _ in range(3):
            before = descriptors.descriptors(program.pid, texts)
        real = descriptors.descriptor_numbers
        monkeypatch.setattr(descriptors, "descriptor_numbers", lambda pid: listed.append(pid) or real(pid))
        line, is_listed = CHANGES_OF_SOME[change]
        program.do(line)
        after = descriptors.descriptors(program.pid, texts)
        assert len(listed) == int(is_listed or not counts)
        assert (after is before) == (change == "nothing")
        assert after == descriptors.descriptors(program.pid)
        for _ in range(3):
            assert descriptors.descriptors(program.pid, texts) == after
    finally:
        if texts is not None:
            texts.close()
        program.end()


def test_a_number_that_leads_elsewhere_by_now_is_told_anew() -> None:
    reader, writer = os.pipe()
    try:
        with kept() as texts, open("/etc/passwd", "rb") as file, socket.socket() as listening:
            assert told(reader, texts).target.startswith("pipe:")
            for source, target in ((file.fileno(), "/etc/passwd"), (listening.fileno(), "socket:"), (writer, "pipe:")):
                os.dup2(source, reader)
                found = told(reader, texts)
                assert found.target.startswith(target)
                assert found.inode == os.fstat(source).st_ino
            file.seek(7)
            os.dup2(file.fileno(), reader)
            assert told(reader, texts).offset == 7
    finally:
        os.close(reader)
        os.close(writer)


def test_a_path_that_is_too_long_to_be_kept_is_told_as_it_is_by_now(tmp_path: Path) -> None:
    place = tmp_path / "before"
    long = place.joinpath(*["directory" * 20] * 3)
    long.mkdir(parents=True)
    with kept() as texts, open(long / "file", "wb") as file:
        for _ in range(LOOKS_UNTIL_KNOWN):
            told(file.fileno(), texts)
        place.rename(tmp_path / "after")
        assert told(file.fileno(), texts).target == os.readlink(f"/proc/self/fd/{file.fileno()}")


def test_what_is_not_asked_of_sockets_and_pipes_is_what_the_kernel_would_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    with contextlib.ExitStack() as stack:
        ours = [*os.pipe(), os.eventfd(3), os.memfd_create("x"), os.pidfd_open(os.getpid()), os.open("/", os.O_PATH)]
        for number in ours:
            stack.callback(os.close, number)
        ours += [stack.enter_context(one).fileno() for one in (*socket.socketpair(), socket.socket())]
        ours.append(stack.enter_context(select.epoll()).fileno())
        quick = [told(number, None) for number in ours]
        monkeypatch.setattr(descriptor, "_nameless", dict)
        asked = [told(number, None) for number in ours]
    quick, asked = ([msgspec.structs.replace(one, mtime_ns=0) for one in found] for found in (quick, asked))
    assert quick == asked


def test_no_more_files_stay_open_than_are_worth_it_and_none_in_the_end() -> None:
    before = sorted(os.listdir("/proc/self/fd"))
    many = [os.eventfd(value) for value in range(TEXTS_KEPT + 50)]
    try:
        with kept() as texts:
            for _ in range(2):
                found = {one.number: one for one in descriptors.descriptors(os.getpid(), texts)}
                assert [int(found[number].fields["eventfd-count"], 16) for number in many] == list(range(len(many)))
            assert len(os.listdir("/proc/self/fd")) <= len(before) + len(many) + TEXTS_KEPT + 1  # and the directory
    finally:
        for number in many:
            os.close(number)
    assert sorted(os.listdir("/proc/self/fd")) == before


HOLDER = """
import fcntl, os, select, sys
path = sys.argv[1]
open(path, "wb").write(b"content")
file, like = (os.open(path, os.O_RDWR) for _ in range(2))
twin = os.dup(file)
counter, other_counter = os.eventfd(3), os.eventfd(3)
reader, writer = os.pipe()
epoll, other_epoll = select.epoll(), select.epoll()
many = [os.eventfd(value) for value in range(20)]
print("ready", flush=True)
for line in sys.stdin:
    exec(line)
    print("done", flush=True)
"""
"""Open files, some of them alike, and two descriptors of one; does what it is told."""


class Holder:
    """Another process, which is looked at again and again."""

    def __init__(self, path: Path) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", HOLDER, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.pid = self._process.pid
        self._kept, self._recollection = Kept(self.pid), Recollection()
        self._await("ready")

    def _await(self, word: str) -> None:
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == f"{word}\n"

    def tell(self, statement: str) -> None:
        """Have it do something."""
        assert self._process.stdin is not None
        self._process.stdin.write(statement + "\n")
        self._process.stdin.flush()
        self._await("done")

    def look(self) -> tuple[OpenFile, ...]:
        """What is said of it by who has looked before."""
        return with_contents(gather(self.pid, self._kept), None, (), self._recollection)

    def look_anew(self) -> tuple[OpenFile, ...]:
        """What is said of it by who sees it for the first time."""
        return with_contents(gather(self.pid), None)

    def end(self) -> None:
        """End it."""
        self._process.kill()
        self._process.communicate()
        self._kept.texts.close()


@pytest.fixture
def holder(tmp_path: Path) -> Iterator[Holder]:
    one = Holder(tmp_path / "file")
    yield one
    one.end()


LOOKS_UNTIL_KNOWN = 3

CHANGES = {
    "an offset": "os.lseek(like, 3, os.SEEK_SET)",
    "an offset of two": "os.lseek(twin, 3, os.SEEK_SET)",
    "a flag": "os.set_blocking(reader, False)",
    "close-on-exec": "os.set_inheritable(counter, True)",
    "a size": "os.write(file, b'more than there was')",
    "a name": "os.rename(path, path + '.other')",
    "that it was deleted": "os.unlink(path)",
    "a mode": "os.chmod(path, 0o600)",
    "a count": "os.eventfd_write(counter, 4)",
    "a twin that leads elsewhere": "os.dup2(like, twin)",
    "two that are one now": "os.dup2(file, like)",
    "counters that are one now": "os.dup2(counter, other_counter)",
    "epolls that are one now": "os.dup2(epoll.fileno(), other_epoll.fileno())",
    "an epoll that is a counter now": "os.dup2(counter, other_epoll.fileno())",
    "a file that is a pipe now": "os.dup2(reader, like)",
    "another file under the same number": "os.close(like); assert os.open('/dev/null', os.O_RDWR) == like",
    "what waits in a pipe": "os.write(writer, b'content')",
    "the capacity of a pipe": "fcntl.fcntl(writer, 1031, 4096)",
    "what an epoll watches": "epoll.register(reader, select.EPOLLIN)",
    "one more": "os.eventfd(0)",
    "one less": "os.close(many[3])",
    "others instead": "[os.close(one) for one in (many[7], many[0], many[-1])]; os.eventfd(77), os.eventfd(78), os.pipe()",
}


@pytest.mark.root
@pytest.mark.parametrize("change", CHANGES)
def test_whatever_changes_is_seen(change: str, holder: Holder) -> None:
    for _ in range(LOOKS_UNTIL_KNOWN):
        before = holder.look()
    again = holder.look()
    assert all(map(operator.is_, (held.descriptors for held in before), (held.descriptors for held in again))), "known by now"
    holder.tell(CHANGES[change])
    for _ in range(LOOKS_UNTIL_KNOWN):
        after = holder.look()
        assert after != before
        assert after == holder.look_anew()


@pytest.mark.root
def test_what_is_known_is_not_compared_one_by_one(holder: Holder, monkeypatch: pytest.MonkeyPatch) -> None:
    for _ in range(LOOKS_UNTIL_KNOWN):
        holder.look()
    monkeypatch.setattr(descriptor_groups, "_place_among", None)
    assert holder.look()


@pytest.mark.root
def test_descriptors_that_all_answer_as_before_are_not_told_one_by_one(holder: Holder, monkeypatch: pytest.MonkeyPatch) -> None:
    for _ in range(LOOKS_UNTIL_KNOWN):
        before = holder.look()
    with monkeypatch.context() as changed:
        changed.setattr(KeptTexts, "read", None)
        assert holder.look() == before
    holder.tell(CHANGES["an offset"])
    assert holder.look() != before
