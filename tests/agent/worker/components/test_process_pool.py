"""The process pool: which guards wait in advance, and when, and how it comes to keepers."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import psutil
import pytest

from agent.errors import KeeperLostError
from agent.guard.messages import Describe
from agent.worker.components import process_pool
from agent.worker.components.process_pool import KeeperLink, ProcessPool
from checkpoint.keeper.messages import Release, Released
from tests.agent.guards import children, lives

PATIENCE_S = 60.0
POLL_S = 0.01


def live(directory: Path, story: Callable[[ProcessPool], Coroutine[Any, Any, None]]) -> None:
    async def whole() -> None:
        process_pool = ProcessPool(directory, "")
        try:
            await asyncio.wait_for(story(process_pool), PATIENCE_S)
        finally:
            await process_pool.close()

    asyncio.run(whole())


def waiting() -> tuple[int, int]:
    """How many of our children are guards, and fork keepers."""
    return len(children("agent.guard.server")), len(children("keepers"))


async def until(guards: int, fork_servers: int) -> None:
    while waiting() != (guards, fork_servers):
        await asyncio.sleep(POLL_S)


def fork_server(*keepers: KeeperLink) -> psutil.Process:
    """Our child that forks keepers; and not one of these, which are our children, too, once their fork server is lost."""
    but = [keeper.pid for keeper in keepers]
    (found,) = (child for child in children("keepers") if child.pid not in but)
    return found


async def answers(keeper: KeeperLink) -> bool:
    reply, _ = await keeper.dialogue.ask(Release())
    return isinstance(reply, Released)


def test_nobody_waits_where_there_is_no_component(tmp_path: Path) -> None:
    async def story(process_pool: ProcessPool) -> None:
        process_pool.expect(0)
        await asyncio.sleep(0.2)
        assert waiting() == (0, 0)

    live(tmp_path, story)


def test_with_the_first_guard_that_is_given_another_one_and_the_fork_server_are_born(tmp_path: Path) -> None:
    async def story(process_pool: ProcessPool) -> None:
        guard = await process_pool.guard()
        await until(1, 1)
        process_pool.expect(0)
        await until(2, 1)  # one more than the one that was given
        guard.close()

    live(tmp_path, story)


def test_what_has_a_ready_copy_needs_no_guard_besides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process_pool, "REFILL_S", 0.0)

    async def story(process_pool: ProcessPool) -> None:
        for name in ("one", "other"):
            process_pool.relieve(name, True)
        process_pool.expect(3)
        await until(1, 1)
        process_pool.relieve("other", False)
        await until(2, 1)

    live(tmp_path, story)


def test_a_guard_waits_for_each_component_that_may_be_taken_over(tmp_path: Path) -> None:
    async def story(process_pool: ProcessPool) -> None:
        process_pool.expect(2)
        await until(2, 1)

    live(tmp_path, story)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_guard_that_was_killed_or_stopped_while_it_waited_is_not_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    monkeypatch.setattr(process_pool, "ANSWER_S", 0.1)

    async def story(process_pool: ProcessPool) -> None:
        process_pool.expect(3)
        await until(3, 1)
        await asyncio.gather(*process_pool._guards)  # all are connected
        lost = children("agent.guard.server")
        for child in lost:
            child.send_signal(number)
        guard = await process_pool.guard()  # before the pool has heard of any end
        await guard.ask(Describe())
        guard.close()
        for child in lost:
            with contextlib.suppress(psutil.NoSuchProcess):
                child.kill()

    live(tmp_path, story)


def test_each_keeper_is_a_process_of_its_own_which_ends_when_it_is_hung_up_on(tmp_path: Path) -> None:
    async def story(process_pool: ProcessPool) -> None:
        keepers = [await process_pool.keeper() for _ in range(3)]
        assert all([await answers(keeper) for keeper in keepers])
        assert sorted(child.pid for child in fork_server().children()) == sorted(keeper.pid for keeper in keepers)
        assert {os.getsid(keeper.pid) for keeper in keepers} == {keeper.pid for keeper in keepers}
        keepers[1].end()
        while psutil.pid_exists(keepers[1].pid):
            await asyncio.sleep(POLL_S)
        assert await answers(keepers[0]) and await answers(keepers[2])
        keepers[0].end()
        keepers[2].end()

    live(tmp_path, story)


def test_without_its_fork_server_the_pool_starts_another_and_the_keepers_serve_on(tmp_path: Path) -> None:
    async def story(process_pool: ProcessPool) -> None:
        first = await process_pool.keeper()
        lost = fork_server()
        lost.kill()
        second = await process_pool.keeper()
        assert fork_server(first).pid != lost.pid
        assert await answers(first) and await answers(second)
        first.end()
        second.end()

    live(tmp_path, story)


def test_a_fork_server_that_is_lost_while_nothing_is_asked_of_it_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process_pool, "REFILL_S", 0.0)

    async def story(process_pool: ProcessPool) -> None:
        process_pool.expect(1)
        await until(1, 1)
        lost = fork_server()
        lost.kill()
        while lives(lost.pid):
            await asyncio.sleep(POLL_S)
        await until(1, 1)

    live(tmp_path, story)


@pytest.mark.skipif(os.geteuid() == 0, reason="root has as many processes as it wants")
def test_a_keeper_that_cannot_be_forked_is_told_with_the_reason(tmp_path: Path) -> None:
    async def story(process_pool: ProcessPool) -> None:
        first = await process_pool.keeper()
        fork_server().rlimit(psutil.RLIMIT_NPROC, (0, 0))
        with pytest.raises(KeeperLostError, match=r"cannot fork a keeper: .*; is memory or the process limit used up"):
            await process_pool.keeper()
        assert await answers(first)
        first.end()

    live(tmp_path, story)


def test_the_fork_server_ends_when_its_keepers_have_ended(tmp_path: Path) -> None:
    """Under systemd its service ends with it, and all that is in it."""

    async def story(process_pool: ProcessPool) -> None:
        keeper = await process_pool.keeper()
        server = fork_server()
        await process_pool.close()
        await asyncio.sleep(0.2)
        assert lives(server.pid) and await answers(keeper)
        keeper.end()
        while lives(server.pid):
            await asyncio.sleep(POLL_S)

    live(tmp_path, story)
