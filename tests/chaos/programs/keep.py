"""A program that keeps its state itself: ``keep.py NAME ACTUATOR PERIOD_MS``. It also reports what it was told is safe."""

import contextlib
import os
import socket
import sys
import threading

import numpy as np

import failover

WAIT_S = 1.0
PAGE = 4096

name, actuator, period_ms = sys.argv[1:]
link = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
newest = (0, 0)
begun = threading.Event()


def tell_safe() -> None:
    """Again and again: this step, or a later one, is safe."""
    begun.wait()
    while True:
        step, seal = newest
        with contextlib.suppress(failover.NotCommittedError):
            failover.wait_committed(WAIT_S)
            link.sendto(f"{name} safe {step} {seal}".encode(), actuator)


state = failover.resume(name, default={"step": 0, "seal": 0, "cloud": np.zeros(1 << 20, np.uint8)})
threading.Thread(target=tell_safe, daemon=True).start()
for _ in failover.every(int(period_ms) / 1000):
    if state["step"]:
        newest = (state["step"], state["seal"])  # each turn that is done is committed
        begun.set()
    before = state["seal"]
    state["step"] += 1
    state["seal"] = (before * 31 + int.from_bytes(os.urandom(4), "little")) % (1 << 32) | 1
    state["cloud"][state["step"] * PAGE % len(state["cloud"])] = state["seal"] & 255
    network = os.readlink("/proc/self/ns/net")
    link.sendto(f"{name} {state['step']} {before} {state['seal']} {failover.epoch()} {network}".encode(), actuator)
    print(state["step"], state["seal"])
