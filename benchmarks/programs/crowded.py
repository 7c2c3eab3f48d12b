"""The program that is measured: many threads that sleep, or many descriptors of one kind.

``python3 crowded.py KIND COUNT``, where KIND is a place in `benchmarks.crowd.KINDS`: prints "ready", then sleeps for ever.
"""

import os
import select
import socket
import sys
import threading
import time
from collections.abc import Callable
from typing import NoReturn


def sleep_on() -> NoReturn:
    while True:
        time.sleep(1)


def threads(count: int) -> None:
    for _ in range(count):
        threading.Thread(target=sleep_on, daemon=True).start()


MAKERS: tuple[Callable[[int], object], ...] = (
    threads,
    lambda count: [os.open(__file__, os.O_RDONLY) for _ in range(count)],
    lambda count: [os.pipe() for _ in range(count // 2)],
    lambda count: [os.eventfd(0) for _ in range(count)],
    lambda count: [select.epoll() for _ in range(count)],
    lambda count: [socket.socketpair() for _ in range(count // 2)],
    lambda count: [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)],
    lambda count: [socket.socket() for _ in range(count)],
)

held = MAKERS[int(sys.argv[1])](int(sys.argv[2]))
print("ready", flush=True)
sleep_on()
