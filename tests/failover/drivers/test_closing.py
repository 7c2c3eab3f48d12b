"""A driver that ends: its last answers to programs of its robot."""

from __future__ import annotations

import socket
import threading

import pytest

from failover.core.messaging.envelope import MESSAGE_SIZE_MAX
from failover.drivers.local import Connection, close_all, framed


@pytest.mark.parametrize("reads", [True, False])
def test_the_last_answers_leave_before_connections_are_closed_and_nobody_who_does_not_read_holds_the_end_up(reads: bool) -> None:
    ours, theirs = socket.socketpair()
    connection = Connection(ours)
    content = b"x" * MESSAGE_SIZE_MAX
    assert connection.send(content) and connection.has_unsent
    found: list[bytes] = []

    def read() -> None:
        while part := theirs.recv(1 << 16):
            found.append(part)

    reader = threading.Thread(target=read)
    if reads:
        reader.start()
    close_all([connection], 60_000 if reads else 10)
    if not reads:
        read()
    else:
        reader.join()
    theirs.close()
    assert (b"".join(found) == framed(content)) is reads
