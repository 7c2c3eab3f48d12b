"""What a program has open is told as it is now, however much was known of it from an earlier look."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import select
import socket
from collections.abc import Iterator

import pytest

from checkpoint.linux import descriptors
from checkpoint.linux.descriptors import TEXTS_KEPT, Descriptor, KeptTexts


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


def test_what_is_not_asked_of_sockets_and_pipes_is_what_the_kernel_would_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    with contextlib.ExitStack() as stack:
        ours = [*os.pipe(), os.eventfd(3), os.memfd_create("x"), os.pidfd_open(os.getpid()), os.open("/", os.O_PATH)]
        for number in ours:
            stack.callback(os.close, number)
        ours += [stack.enter_context(one).fileno() for one in (*socket.socketpair(), socket.socket())]
        ours.append(stack.enter_context(select.epoll()).fileno())
        quick = [told(number, None) for number in ours]
        monkeypatch.setattr(descriptors, "_nameless", dict)
        asked = [told(number, None) for number in ours]
    assert [dataclasses.replace(one, mtime_ns=0) for one in quick] == [dataclasses.replace(one, mtime_ns=0) for one in asked]


def test_no_more_files_stay_open_than_are_worth_it_and_none_in_the_end() -> None:
    before = sorted(os.listdir("/proc/self/fd"))
    many = [os.eventfd(value) for value in range(TEXTS_KEPT + 50)]
    try:
        with kept() as texts:
            for _ in range(2):
                found = {one.number: one for one in descriptors.descriptors(os.getpid(), texts)}
                assert [int(found[number].fields["eventfd-count"], 16) for number in many] == list(range(len(many)))
            assert len(os.listdir("/proc/self/fd")) <= len(before) + len(many) + TEXTS_KEPT
    finally:
        for number in many:
            os.close(number)
    assert sorted(os.listdir("/proc/self/fd")) == before
