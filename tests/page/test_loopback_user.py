"""Whose program is at the other end of a connection on this machine: as the kernel has it."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from page.loopback_user import uid_of

OTHER = 65_534


@contextmanager
def connected(host: str) -> Iterator[tuple[tuple[str, int], tuple[str, int]]]:
    """Both ends of a connection of the present user: client, server."""
    try:
        listening = socket.create_server((host, 0), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
    except OSError:
        pytest.skip(f"this machine has no {host}")
    with listening, socket.create_connection(listening.getsockname()[:2]) as client:
        yield client.getsockname()[:2], listening.getsockname()[:2]


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_our_own_connection_is_ours(host: str) -> None:
    with connected(host) as (client, server):
        assert uid_of(client, server) == os.geteuid()


def test_a_connection_that_is_not_there_is_no_users() -> None:
    assert uid_of(("127.0.0.1", 1), ("127.0.0.1", 2)) is None


def test_a_connection_that_its_program_has_closed_is_no_users() -> None:
    """The kernel's table names user 0 for it, which is root."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        client = socket.create_connection(listening.getsockname())
        ends = client.getsockname(), listening.getsockname()
        taken, _ = listening.accept()
        with taken:
            client.close()
            assert uid_of(*ends) is None, "still half open"
        assert uid_of(*ends) is None, "it rests (TIME_WAIT)"


@pytest.mark.root
def test_a_socket_is_of_the_user_who_made_it() -> None:
    os.seteuid(OTHER)
    try:
        with connected("127.0.0.1") as (client, server):
            assert uid_of(client, server) == OTHER
    finally:
        os.seteuid(0)
