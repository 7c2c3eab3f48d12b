"""A driver in asyncio: it reads a wheel's counter over a socket, and never loses or counts twice a tick of it.

    python driver.py [FRAMES]       for ever, or so many frames; kill it at any time, and start it again

Sockets, tasks and the event loop are no part of the state: they are opened anew, and the device is asked for what comes next.
"""

from __future__ import annotations

import asyncio
import socket
import sys
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

import failover

LAST = int(sys.argv[1]) if len(sys.argv) > 1 else None
PERIOD_S = 0.01
WRAP = 1 << 16  # the device counts with 16 bits, and begins again at 0
METRES = 1e-5  # of one tick
TOGETHER = 5  # frames between two commits: the points at which the speeds fit the way


@dataclass
class Odometer:
    """All that must survive."""

    frames: int = 0
    counter: int = 0
    ticks: int = 0
    speeds: deque[float] = field(default_factory=lambda: deque(maxlen=TOGETHER))

    def take(self, counter: int) -> None:
        """The next frame of the device."""
        moved = (counter - self.counter) % WRAP
        self.frames, self.counter, self.ticks = self.frames + 1, counter, self.ticks + moved
        self.speeds.append(moved * METRES / PERIOD_S)


async def device(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """What a real device would be: asked for a frame, it sends that one and all that follow."""
    frame = int(await reader.readline())
    while not writer.is_closing():
        frame += 1
        writer.write(b"%d\n" % (frame * (1000 + frame % 700) % WRAP))
        await asyncio.sleep(PERIOD_S)


@asynccontextmanager
async def connected() -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    """A connection to the device."""
    near, far = socket.socketpair()
    there = asyncio.create_task(device(*await asyncio.open_connection(sock=far)))
    reader, writer = await asyncio.open_connection(sock=near)
    try:
        yield reader, writer
    finally:
        there.cancel()
        writer.close()


@failover.resumable(name="driver")
async def drive(odometer: Odometer) -> AsyncIterator[None]:
    """Take in frame after frame; each ``yield`` is a commit."""
    if resumed := failover.resumed():
        print(f"goes on after frame {odometer.frames}, {resumed.age_s:.2f} s old", file=sys.stderr, flush=True)
    async with connected() as (reader, writer):
        writer.write(b"%d\n" % odometer.frames)
        while odometer.frames != LAST:
            odometer.take(int(await reader.readline()))
            way, speed = odometer.ticks * METRES, sum(odometer.speeds) / len(odometer.speeds)
            print(f"{odometer.frames} after {way:.3f} m, {speed:.3f} m/s", flush=True)
            if odometer.frames % TOGETHER == 0:
                yield


asyncio.run(drive(Odometer()))
