"""The same as count.c in Python, and equally unprepared: ``count.py NAME ACTUATOR PERIOD_MS``."""

import ctypes
import os
import socket
import sys
import time

getenv = ctypes.CDLL(None).getenv  # os.environ is a copy from the beginning
getenv.restype = ctypes.c_char_p
name, actuator, period_ms = sys.argv[1:]
ballast = bytearray(1 << 20)
step = seal = 0
while True:
    step, before = step + 1, seal
    seal = (seal * 31 + int.from_bytes(os.urandom(4), "little")) % (1 << 32) | 1
    ballast[step * 4096 % len(ballast)] = seal & 255
    epoch = (getenv(b"FAILOVER_EPOCH") or b"0").decode()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.sendto(f"{name} {step} {before} {seal} {epoch} {os.readlink('/proc/self/ns/net')}".encode(), actuator)
    print(step, seal, flush=True)
    time.sleep(int(period_ms) / 1000)
