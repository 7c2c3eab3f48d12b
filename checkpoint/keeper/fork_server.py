"""Starts an agent's keepers: ``python -m checkpoint keepers FD``, or ``keepers PATH``, where it listens for the agent.

It has loaded all that a keeper needs, and forks one for each `Fork` that it is sent. So a keeper begins within milliseconds, and
keepers share the memory of the interpreter and of what is loaded (`docs/performance.md`). A last word is their `gates`.

It has one thread and serves nothing itself: what a fork copies is at rest. When its peer has gone, it ends, but only after its
keepers, which let go of their programs: under systemd they are in its service, which ends with it.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
from pathlib import Path
from typing import Final

import checkpoint
from checkpoint.errors import CaptureError
from checkpoint.keeper import messages, server
from checkpoint.keeper.messages import Channel, ChannelClosedError, Fork, Forked
from checkpoint.linux.unix_address import address_of

USAGE: Final = f"usage: python -m {checkpoint.__name__} keepers FD|PATH [MODULE]\n"

CALL_S: Final = 30.0
"""How long one that listens waits for its peer."""


def main(arguments: list[str]) -> int:
    """Start keepers for the agent at an inherited socket, or for the first one that connects at a path; be one in a child."""
    if len(arguments) not in (2, 3) or arguments[0] != "keepers":
        sys.stderr.write(USAGE)
        return 2
    server.prepare()
    try:
        end = socket.socket(fileno=int(arguments[1])) if arguments[1].isdigit() else _called_at(arguments[1])
    except OSError as error:
        sys.stderr.write(f"keepers: no agent to serve at {arguments[1]}: {error.strerror or error}\n")
        return 1
    keepers_end = _forks(Channel(end, Fork))
    if keepers_end is not None:
        server.serve(keepers_end, *arguments[2:])
    else:
        _await_keepers()
    return 0


def _forks(link: Channel[Fork]) -> socket.socket | None:
    """Fork until the peer hangs up, then None; in a child: its own socket to that peer."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the kernel reaps them
    with contextlib.suppress(ChannelClosedError):
        while True:
            _, descriptors = link.receive()
            try:
                pid = os.fork()
                if not pid:
                    return _in_child(link, descriptors)
                link.send(Forked(pid))
            except OSError as error:
                link.send(messages.failed(CaptureError(f"cannot fork a keeper: {error.strerror}")))
            finally:
                messages.close_all(descriptors)
    return None


def _in_child(link: Channel[Fork], descriptors: tuple[int, ...]) -> socket.socket:
    """What is the server's alone is given up; the child has the same signals as one that was started alone."""
    link.close()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.setsid()
    return socket.socket(fileno=os.dup(descriptors[0]))


def _await_keepers() -> None:
    with contextlib.suppress(ChildProcessError):  # ignored children: raised once the last one has ended
        os.wait()


def _called_at(path: str) -> socket.socket:
    """Listen at a path (0600) until a client connects. No other client can connect afterwards.

    Raises:
        OSError: it cannot listen there, or no client came.
    """
    before = os.umask(0o177)
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC) as listener:
            with address_of(Path(path)) as address:
                listener.bind(address)
            os.umask(before)
            listener.listen(1)
            listener.settimeout(CALL_S)
            end, _ = listener.accept()
    finally:
        os.umask(before)
        with contextlib.suppress(FileNotFoundError):
            os.unlink(path)
    end.settimeout(None)
    return end
