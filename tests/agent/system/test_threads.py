"""A thread that writes by a descriptor ends before its caller closes the descriptor, also where the caller is cancelled."""

from __future__ import annotations

import asyncio
import os
import threading
from pathlib import Path

import pytest

from agent.system.threads import to_its_end


def test_it_answers_what_the_function_returns_and_raises_what_it_raises() -> None:
    def fail() -> None:
        raise OSError("the disk is full")

    assert asyncio.run(to_its_end(divmod, 7, 2)) == (3, 1)
    with pytest.raises(OSError, match="full"):
        asyncio.run(to_its_end(fail))


@pytest.mark.parametrize("times", [1, 3])
def test_a_cancelled_caller_closes_nothing_under_a_thread_that_writes(times: int, tmp_path: Path) -> None:
    """The number of the closed descriptor is that of another file at once: the thread would write into that."""
    begun, may_go_on = threading.Event(), threading.Event()
    other: list[int] = []

    def write(descriptor: int) -> None:
        begun.set()
        may_go_on.wait()
        os.write(descriptor, b"mine")

    async def owner() -> None:
        descriptor = os.open(tmp_path / "mine", os.O_CREAT | os.O_WRONLY)
        try:
            await to_its_end(write, descriptor)
        finally:
            os.close(descriptor)
            other.append(os.open(tmp_path / "other", os.O_CREAT | os.O_WRONLY))

    async def play() -> None:
        task = asyncio.create_task(owner())
        await asyncio.to_thread(begun.wait)
        for _ in range(times):
            task.cancel()
            await asyncio.sleep(0)
            await asyncio.sleep(0)
        may_go_on.set()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(play())
    os.close(other[0])
    assert ((tmp_path / "mine").read_bytes(), (tmp_path / "other").read_bytes()) == (b"mine", b"")
