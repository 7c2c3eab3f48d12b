"""Many system calls of this process in one batch."""

import array
import ctypes
import errno
import os
import socket
from collections.abc import Callable

import pytest

from checkpoint.linux import batch_syscalls
from checkpoint.linux.batch_syscalls import FIRST_ARGUMENT, ROW_SIZE, OwnCalls, row

WAYS = (
    pytest.param(batch_syscalls._in_machine_code, id="machine code"),
    pytest.param(lambda: batch_syscalls.one_by_one, id="one by one"),
)


@pytest.fixture(params=WAYS)
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> batch_syscalls.Loop:
    make: Callable[[], batch_syscalls.Loop] = request.param
    loop = make()
    monkeypatch.setattr(batch_syscalls, "_loop", lambda: loop)
    return loop


def test_every_call_of_a_table_is_made_and_its_result_put_where_it_is_wanted(way: batch_syscalls.Loop) -> None:
    results = array.array("q", [7] * 3)
    place = results.buffer_info()[0]
    table = OwnCalls([row("getpid", to=place), row("close", -1, to=place + 8), row("getpid")])
    table.run()
    assert results.tolist() == [os.getpid(), -errno.EBADF, 7]


def test_only_the_rows_that_are_asked_for_are_made(way: batch_syscalls.Loop) -> None:
    results = array.array("q", [0] * 4)
    place = results.buffer_info()[0]
    table = OwnCalls([row("getpid", to=place + 8 * index) for index in range(4)])
    table.run(1, 3)
    assert results.tolist() == [0, os.getpid(), os.getpid(), 0]
    table.run(3, 3)
    assert results[3] == 0
    OwnCalls(0).run()


def test_a_result_may_be_an_argument_of_a_later_call(way: batch_syscalls.Loop) -> None:
    there, here = socket.socketpair()
    with there, here:
        there.send(b"all six arguments count")
        buffer = bytearray(64)
        content = (ctypes.c_char * 64).from_buffer(buffer)
        result = array.array("q", [0])
        table = OwnCalls(3)
        at = ctypes.addressof(content)
        descriptor = table.address_of(1, FIRST_ARGUMENT)
        table.entries[0] = row("pidfd_open", os.getpid(), to=descriptor)
        table.entries[1] = row("pidfd_getfd", 0, here.fileno(), to=table.address_of(2, FIRST_ARGUMENT))
        table.entries[2] = row("recvfrom", 0, at, 64, socket.MSG_PEEK, 0, 0, to=result.buffer_info()[0])
        table.run()
        assert buffer[: result[0]] == b"all six arguments count"
        for index in (1, 2):
            os.close(int(table.entries[index, FIRST_ARGUMENT]))


def test_cells_are_the_words_of_the_rows() -> None:
    table = OwnCalls(2)
    table.cells[8 + FIRST_ARGUMENT] = 42
    assert table.entries[1, FIRST_ARGUMENT] == 42
    assert table.address_of(1, FIRST_ARGUMENT) == table.address + ROW_SIZE + 8
