"""The channel between a host and the process of a program that was sent: that process may say anything."""

from __future__ import annotations

import socket
import struct

import pytest

from failover.programs.channel import Channel, ChannelClosedError


@pytest.mark.parametrize(
    "content",
    [b"", b"\xc1", b"\x82\xa4type\xa6failed\xa8sentence\xa2\xff\xff", b"\x81\xa4type\xa1\xff", b"\x91" * 100_000, b"\x80"],
)
def test_what_is_no_message_ends_the_conversation_and_not_the_host(content: bytes) -> None:
    host, program = socket.socketpair()
    with host, program:
        program.sendall(struct.pack("!I", len(content)) + content)
        with pytest.raises(ChannelClosedError, match="its process sent what is no message"):
            Channel(host).receive(5.0)
