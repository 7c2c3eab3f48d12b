"""A gripper that obeys no replaced program, and the program that drives it.

    python gripper.py serve SOCKET STATE      at the gripper: STATE remembers the highest epoch
    failover run -- python gripper.py drive SOCKET

Two copies of the driver may live for an instant, when a robot was cut off or hung. Each command carries the epoch under which its
sender runs; the gateway refuses older ones, so the gripper closes once.
"""

from __future__ import annotations

import contextlib
import os
import socket
import sys
import threading
import time
from pathlib import Path

import failover

PERIOD_S = 0.02


def serve(place: str, state: str) -> None:
    """Obey, and tell on standard output what was obeyed and what was refused."""
    gateway = failover.Gateway(state)
    Path(place).unlink(missing_ok=True)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(place)
        listener.listen()
        while True:
            controller, _ = listener.accept()
            threading.Thread(target=hear, args=(controller, gateway), daemon=True).start()


def hear(controller: socket.socket, gateway: failover.Gateway) -> None:
    """One controller, until it goes away: a line ``EPOCH STEP`` a command, answered each."""
    with contextlib.suppress(ConnectionError), controller, controller.makefile("rw") as lines:
        for line in lines:
            epoch, step = (int(word) for word in line.split())
            try:
                with gateway.passing(epoch):
                    tell(f"{epoch} {step} obeyed")  # here it would move
                answer = "obeyed"
            except failover.StaleEpochError as stale:
                answer = f"refused: {stale}"
                tell(f"{epoch} {step} {answer}")
            lines.write(answer + "\n")
            lines.flush()


def tell(line: str) -> None:
    """Several controllers are heard at once: each line is one write."""
    os.write(sys.stdout.fileno(), f"{line}\n".encode())


def drive(place: str) -> None:
    """Give a command in each step; what is kept is how many were given."""
    kept = failover.resume("gripper", default={"step": 0})
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as gripper:
        gripper.connect(place)
        with gripper.makefile("rw") as lines:
            for _ in failover.every(PERIOD_S):
                lines.write(f"{failover.epoch()} {kept['step'] + 1}\n")
                lines.flush()
                if lines.readline().startswith("refused"):
                    stand_by()
                kept["step"] += 1


def stand_by() -> None:
    """Another robot drives; this copy is about to be ended, and moves nothing until then."""
    print("another robot drives the gripper", file=sys.stderr, flush=True)
    while True:
        time.sleep(1)


if __name__ == "__main__":
    serve(*sys.argv[2:]) if sys.argv[1] == "serve" else drive(sys.argv[2])
