"""Two ends of a TCP connection, each a process of its own, which send each other what a test can check byte for byte.

    python3 talkers.py caller HOST PORT OWN [ends]     connects from an address of its own; the program that is captured
    python3 talkers.py caller HOST PORT OWN posts      sends its end to itself in a message, and takes it out at the end
    python3 talkers.py called HOST PORT OWN [ends]     listens; its peer, which knows of nothing

Both send until nothing more is taken, while neither reads, and say "ready". Once the file ``go`` is there each reads all that the
other has sent, sends something more, and ends its side. Each then says "ok", or what was wrong. One that is told ``ends`` sends
little, and ends its side before it is ready.
"""

from __future__ import annotations

import os
import socket
import sys
import threading
import time

PATTERN = b"".join(b"%07d\n" % number for number in range(1 << 17))
LITTLE = 1000
LAST = b"the last words"


def said(size: int) -> bytes:
    """What an end that has filled its connection has said."""
    return (PATTERN * (size // len(PATTERN) + 1))[:size]


def fill(end: socket.socket) -> int:
    """Send until nothing more is taken: how much was."""
    end.setblocking(False)
    total, full = 0, 0
    while full < 20:
        try:
            total += end.send(PATTERN[total % len(PATTERN) :][:65536])
            full = 0
        except BlockingIOError:
            full += 1
            time.sleep(0.01)
    end.setblocking(True)
    return total


def heard(end: socket.socket) -> bytes:
    """All that the other end says until it ends."""
    pieces = []
    while piece := end.recv(1 << 20):
        pieces.append(piece)
    return b"".join(pieces)


def talk(end: socket.socket, *, ends: bool) -> str:
    """What was wrong; "ok" if nothing."""
    total = LITTLE if ends else fill(end)
    complaints: list[str] = []

    def say() -> None:
        try:
            end.sendall((said(total) if ends else b"") + LAST + b" %d" % total)
            end.shutdown(socket.SHUT_WR)
        except OSError as error:  # the kernel tells it once, to whoever asks first
            complaints.append(f"{error.strerror} ({error.errno})")

    if ends:
        say()
    print("ready", flush=True)
    while not os.path.exists("go"):
        time.sleep(0.01)
    saying = threading.Thread(target=(lambda: None) if ends else say)
    saying.start()
    try:
        found = heard(end)
    except OSError as error:
        return f"{error.strerror} ({error.errno})"
    saying.join()
    if complaints:
        return complaints[0]
    body, mark, size = found.rpartition(LAST)
    if not mark or int(size) != len(body):
        return f"{len(found)} bytes, which end in {found[-40:]!r}"
    return "ok" if body == said(len(body)) else "other bytes than were said"


def posted(end: socket.socket) -> str:
    """What becomes of an end that is on its way in a message while the program is captured."""
    box, letter = socket.socketpair()
    fill(end)
    socket.send_fds(letter, [b"."], [end.fileno()])
    end.close()
    print("ready", flush=True)
    while not os.path.exists("go"):
        time.sleep(0.01)
    _, (number,), _, _ = socket.recv_fds(box, 1, 1)
    try:
        return f"{len(heard(socket.socket(fileno=number)))} bytes"
    except OSError as error:
        return f"{error.strerror} ({error.errno})"


def main(part: str, host: str, port: str, own: str, *how: str) -> None:
    """Be one of the two."""
    if part == "called":
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        listener = socket.create_server((host, int(port)), family=family)
        print("listens", flush=True)
        end, _ = listener.accept()
    else:
        end = socket.create_connection((host, int(port)), source_address=(own, 0))
    print(posted(end) if "posts" in how else talk(end, ends="ends" in how), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
