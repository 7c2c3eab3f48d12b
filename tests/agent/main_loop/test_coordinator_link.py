"""The main loop's end of the process that speaks with etcd: a process that hangs, and a machine that has no room for one."""

from __future__ import annotations

import errno
import os
import select
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from agent import config as configuration
from agent.core_config import team_config
from agent.main_loop import coordinator_link
from agent.main_loop.coordinator_link import BIRTH_NS, PAUSE_NS, CoordinatorLink
from failover.config import team
from failover.config.team import Robot, Team
from failover.core.election.coordinator import Word

PATIENCE_S = 60
NOW_NS = 10_000_000_000
NOBODY = "http://127.0.0.1:1"


@pytest.fixture
def link(tmp_path: Path) -> Iterator[CoordinatorLink]:
    """Of a robot whose etcd is not there."""
    members = {f"r{one}": Robot((f"127.0.0.1:74{one}0",), f"127.0.0.1:74{one}1") for one in (1, 2)}
    team.write(tmp_path / "team", Team("lab", members))
    path = tmp_path / "agent.toml"
    places = "".join(f'{part}_directory = "{tmp_path / part}"\n' for part in ("team", "state", "runtime"))
    etcd = f'rule = "etcd"\nlease_ms = 1800\n[coordinator]\nendpoints = ["{NOBODY}"]\n'
    path.write_text(f'robot = "r1"\ninsecure = true\n{places}{etcd}')
    settings = configuration.load(path)
    path.unlink()  # what the process needs it is told
    one = CoordinatorLink(settings, team_config(settings))
    yield one
    one.close()


def until_heard(link: CoordinatorLink, now_ns: int) -> None:
    assert select.select([link.fileno()], [], [], PATIENCE_S)[0], "the process has said nothing"
    link.receive(now_ns)


def test_a_process_that_says_nothing_is_killed_and_another_one_answers(link: CoordinatorLink) -> None:
    assert link.start(NOW_NS)
    link.look(Word(1, 1), NOW_NS)
    until_heard(link, NOW_NS)
    assert "no etcd answers" in link.trouble
    hung = link._child
    assert hung is not None
    os.kill(hung.pid, signal.SIGSTOP)

    asked_ns = link.next_ns()
    link.look(Word(1, 2), asked_ns)
    until_ns = link.next_ns()
    assert until_ns > asked_ns and not link.is_hung(until_ns - 1) and link.is_hung(until_ns)
    link.stop(until_ns)
    assert hung.wait(PATIENCE_S) == -signal.SIGKILL
    assert "it was silent for 5 s" in link.trouble and link.next_ns() == until_ns + PAUSE_NS
    assert not link.is_over(until_ns) and link.is_over(until_ns + PAUSE_NS)

    assert link.start(until_ns + PAUSE_NS)
    link.look(Word(1, 3), until_ns + 2 * PAUSE_NS)
    until_heard(link, until_ns + PAUSE_NS)
    assert "no etcd answers" in link.trouble


def test_a_process_that_is_not_born_yet_is_given_longer(link: CoordinatorLink) -> None:
    assert link.start(NOW_NS)
    link.look(Word(1, 1), NOW_NS)
    assert link.next_ns() == NOW_NS + BIRTH_NS


def test_a_machine_without_room_for_a_process_is_tried_later(link: CoordinatorLink, monkeypatch: pytest.MonkeyPatch) -> None:
    def none_left(*_: object) -> None:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    def no_thread(*_: object) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patched:
        patched.setattr(coordinator_link, "pair", none_left)
        assert not link.start(NOW_NS) and link.has_ended and "Too many open files" in link.trouble
    before = len(os.listdir("/proc/self/fd"))
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", no_thread)
        assert not link.start(NOW_NS) and "can't start new thread" in link.trouble
    assert len(os.listdir("/proc/self/fd")) == before
    assert link.is_over(NOW_NS + PAUSE_NS) and link.start(NOW_NS + PAUSE_NS)
    assert not link.has_ended


def test_the_main_loop_sleeps_until_the_first_heartbeat_has_left(link: CoordinatorLink) -> None:
    assert link.start(NOW_NS)
    now_ns = time.monotonic_ns()
    link.look(Word(1, 0), now_ns)
    assert link.wants_word and link.next_ns() > now_ns
