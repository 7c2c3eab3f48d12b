"""What a program has posted outlives it: a file holds it, and its next life sends it."""

from __future__ import annotations

import contextlib
import gc
import os
import random
import resource
import subprocess
import sys
import time
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from failover.core.messaging.envelope import Envelope
from failover.core.messaging.mailbox import Outbox
from failover.drivers import posts_file
from failover.drivers.here import Here
from failover.drivers.lookup import lookup
from failover.drivers.posts_file import FOLDER, NS, PostsFile, place_of
from failover.drivers.proxy import Proxy
from failover.errors import CallRefusedError, DriverError
from tests.failover.drivers.devices import ENGINE, Engine
from tests.failover.drivers.serving import LIMIT_S, serving

MISSION = """
import sys, failover
with failover.proxy("engine", sender="mission", durable=True) as engine:
    engine.call("set", duty=0.0)
    print("called", flush=True)
    sys.stdin.readline()
    for number in range(1, 6):
        engine.post("set", duty=number / 10)
    print("posted", flush=True)
    sys.stdin.readline()
"""


@pytest.fixture(autouse=True)
def kept(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(FOLDER, str(folder))
    return folder


def mission(here: Here) -> Proxy:
    return Proxy(here, lookup(here, "engine"), sender="mission", durable=True)


def test_what_a_killed_program_has_posted_is_carried_out_first_in_order_and_once(here: Here, kept: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", MISSION], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdin is not None and program.stdout is not None
        with serving(Engine, here) as engine:
            assert program.stdout.readline() == "called\n"
            assert engine.instance.heard == [0.0]
        program.stdin.write("\n")
        program.stdin.flush()
        assert program.stdout.readline() == "posted\n"
        program.kill()
    with serving(Engine, here) as engine:
        with mission(here) as proxy:
            proxy.call("set", duty=0.6, timeout=LIMIT_S)
            assert [one.result(0) for one in proxy.left_over] == [None] * 5
        assert engine.instance.heard == [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
        with mission(here) as proxy:
            assert proxy.left_over == ()
    assert [*kept.glob("*.posts")] == [kept / "robot1.mission-to-Lab.Robotino.Engines.3.PWM.posts"]


def test_a_block_ends_without_an_error_although_the_driver_is_away_for_what_was_posted_is_kept(
    here: Here, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("failover.drivers.proxy.TIMEOUT_S", 0.01)
    with serving(Engine, here):
        place = lookup(here, "engine")
    with Proxy(here, place, sender="mission", durable=True) as proxy:
        done = proxy.post("set", duty=0.5)
    with pytest.raises(Exception, match="it is kept, and sent when its sender runs again"):
        done.result(0)
    with serving(Engine, here) as engine, mission(here) as proxy:
        assert proxy.left_over[0].result(LIMIT_S) is None and engine.instance.heard == [0.5]


def test_a_sender_that_was_not_durable_or_in_another_folder_meanwhile_is_heard_again(
    here: Here, kept: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = kept / "other"
    other.mkdir()
    with serving(Engine, here) as engine:
        for number, (folder, durable) in enumerate([(kept, True), (kept, False), (kept, True), (other, True), (kept, True)]):
            monkeypatch.setenv(FOLDER, str(folder))
            with Proxy(here, lookup(here, "engine"), sender="mission", durable=durable) as proxy:
                proxy.call("set", duty=number / 10)
        assert engine.instance.heard == [0.0, 0.1, 0.2, 0.3, 0.4]


def test_what_a_later_life_of_its_sender_keeps_from_the_driver_stays_in_the_file(
    here: Here, kept: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("failover.drivers.proxy.TIMEOUT_S", 0.01)
    with serving(Engine, here):
        place = lookup(here, "engine")
    with Proxy(here, place, sender="mission", durable=True) as proxy:
        proxy.post("set", duty=0.1)
    with serving(Engine, here) as engine:
        with Proxy(here, lookup(here, "engine"), sender="mission") as proxy:
            proxy.call("set", duty=0.2, timeout=LIMIT_S)
        for _ in range(2):
            with (
                mission(here) as proxy,
                pytest.raises(CallRefusedError, match="since: move it away") as caught,
            ):
                proxy.left_over[0].result(LIMIT_S)
            assert caught.value.kind == "outlived"
        next(kept.glob("*.posts")).unlink()
        with mission(here) as proxy:
            proxy.call("set", duty=0.3, timeout=LIMIT_S)
        assert engine.instance.heard == [0.2, 0.3]


def test_two_processes_of_a_durable_sender_are_refused_and_so_is_one_without_a_name(here: Here) -> None:
    with serving(Engine, here):
        with mission(here) as proxy:
            with pytest.raises(DriverError, match="another process posts as robot1/mission"):
                mission(here)
            proxy.call("set", duty=0.1)
        with pytest.raises(DriverError, match="give it a sender"):
            Proxy(here, lookup(here, "engine"), durable=True)


class Forgetful(weakref.WeakSet[PostsFile]):
    """Of it a process that was forked gives up no file."""

    def add(self, item: PostsFile) -> None:
        """Leave it out."""


@pytest.mark.parametrize("runs_before_its_parent", [True, False])
def test_a_proxy_that_is_garbage_or_a_process_that_was_forked_holds_no_file(
    here: Here, monkeypatch: pytest.MonkeyPatch, runs_before_its_parent: bool
) -> None:
    if not runs_before_its_parent:
        monkeypatch.setattr(posts_file, "_OPEN", Forgetful())
    with serving(Engine, here) as engine:
        proxy = mission(here)
        proxy.call("set", duty=0.1)
        del proxy
        gc.collect()
        proxy = mission(here)
        ends, wakes = os.pipe()
        child = os.fork()
        if not child:
            os.close(wakes)
            os.read(ends, 1)
            os._exit(0)
        try:
            proxy.close()
            with mission(here) as proxy:
                proxy.call("set", duty=0.2)
        finally:
            os.close(wakes)
            os.close(ends)
            assert os.waitpid(child, 0)[1] == 0
        assert engine.instance.heard == [0.1, 0.2]


def test_a_process_that_was_forked_does_not_write_what_its_parent_keeps(file: PostsFile) -> None:
    outbox = Outbox("robot1/mission", 7)
    post(outbox, file)
    before = file.path.read_bytes()
    child = os.fork()
    if not child:
        file.over(1)
        try:
            post(outbox, file)
        except DriverError:
            os._exit(0)
        os._exit(1)
    assert os.waitpid(child, 0)[1] == 0 and file.path.read_bytes() == before
    post(outbox, file)


def test_without_a_working_directory_a_durable_sender_is_refused(
    here: Here, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(FOLDER)
    gone = folder / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    with serving(Engine, here), pytest.raises(DriverError, match="working directory: No such file or directory; FAILOVER_STATE"):
        mission(here)


def test_a_file_of_another_driver_whose_name_is_written_alike_is_refused(file: PostsFile) -> None:
    file.close()
    alike = ENGINE.replace("/", ".")
    assert place_of("robot1/mission", alike) == file.path
    with pytest.raises(DriverError, match=f"holds what robot1/mission has posted to {ENGINE}: use another sender"):
        PostsFile("robot1/mission", alike, 7, 0)


@pytest.fixture
def file() -> Iterator[PostsFile]:
    found = opened()
    yield found
    found.close()


def opened() -> PostsFile:
    return PostsFile("robot1/mission", ENGINE, 7, 0)


def waiting(file: PostsFile) -> list[int]:
    return [one.envelope.seq for one in file.kept.waiting]


def post(outbox: Outbox, file: PostsFile) -> int:
    posted = outbox.post(Envelope(to=ENGINE, verb="set", body={"text": "x" * 100}, reliable=True), 0)
    file.posted(posted, None, 0)
    return posted.seq


def test_a_file_cut_within_any_record_holds_what_was_kept_until_then(file: PostsFile) -> None:
    dice = random.Random(1)
    outbox, held = Outbox("robot1/mission", 7), [0]
    sizes = {file.path.stat().st_size: ([], 0)}
    now: list[int] = []
    for _ in range(12):
        if now and dice.random() < 0.4:
            file.over(now.pop(dice.randrange(len(now))))
        else:
            now.append(post(outbox, file))
            held.append(now[-1])
        sizes[file.path.stat().st_size] = ([*now], held[-1])
    whole = file.path.read_bytes()
    file.close()
    cuts = {size + more for size in sizes for more in (0, 1, 19, 20, 21, 60) if size + more <= len(whole)} | {
        size - 1 for size in sizes if size > min(sizes)
    }
    for cut in sorted(cuts):
        file.path.write_bytes(whole[:cut])
        again = opened()
        left, last = sizes[max(size for size in sizes if size <= cut)]
        expected = (left, last, 7) if left else ([], 0, 8)
        assert (waiting(again), again.kept.seq, again.kept.boot) == expected, f"cut at {cut}"
        again.close()


def test_a_power_cut_may_leave_anything_where_the_disk_was_not_waited_for(file: PostsFile) -> None:
    outbox = Outbox("robot1/mission", 7)
    for _ in range(4):
        post(outbox, file)
    safe = file.path.stat().st_size
    for seq in (1, 2):
        file.over(seq)
    whole = file.path.read_bytes()
    file.close()
    over = (len(whole) - safe) // 2
    for torn in (bytes(2 * over), b"\xff" * over, random.Random(1).randbytes(3 * over), bytes(over) + whole[safe + over :]):
        file.path.write_bytes(whole[:safe] + torn)
        again = opened()
        assert (waiting(again), again.kept.seq) == ([1, 2, 3, 4], 4)
        again.close()


@pytest.mark.parametrize(
    ("place", "is_anew", "is_behind"), [(0, False, False), (1, False, False), (2, False, True), (2, True, False), (0, True, True)]
)
def test_a_file_that_is_damaged_is_refused_and_stays_as_it_is(
    file: PostsFile, place: int, is_anew: bool, is_behind: bool
) -> None:
    """Also its last message, once the file says behind it, or was written anew, with it: it was safe."""
    outbox = Outbox("robot1/mission", 7)
    begins = []
    for _ in range(3):
        begins.append(file.path.stat().st_size)
        post(outbox, file)
    if is_anew:
        file.close()
        file = opened()
    if is_behind:
        file.over(1)
    whole = bytearray(file.path.read_bytes())
    file.close()
    whole[begins[place] + 40] ^= 1
    file.path.write_bytes(whole)
    with pytest.raises(DriverError, match=f"is damaged at byte {begins[place]}; move it away"):
        opened()
    assert file.path.read_bytes() == whole


@pytest.mark.parametrize("body", [{"v": [0.5] * 60_000, "t": "x" * 780_000}, {"v": [0.5] * 65_530}])
def test_the_largest_messages_are_kept_as_any(here: Here, monkeypatch: pytest.MonkeyPatch, body: dict[str, Any]) -> None:
    monkeypatch.setattr("failover.drivers.proxy.TIMEOUT_S", 0.01)
    with serving(Engine, here):
        place = lookup(here, "engine")
    with Proxy(here, place, sender="mission", durable=True) as proxy:
        for one in ({"duty": 0.1}, body, {"duty": 0.2}):
            proxy.post("set", one)
    with Proxy(here, place, sender="mission", durable=True) as proxy:
        assert len(proxy.left_over) == 3


def test_a_message_that_the_file_could_not_give_back_is_not_written(file: PostsFile) -> None:
    for body in ({"v": object()}, {"v": "\ud800"}, _deep(2_000)):
        with pytest.raises(DriverError, match="cannot keep the message robot1-7-1 in"):
            file.posted(Envelope(to=ENGINE, id="robot1-7-1", seq=1, body=body), None, 0)
    file.posted(Envelope(to=ENGINE, seq=1), None, 0)
    file.close()
    again = opened()
    assert waiting(again) == [1]
    again.close()


def _deep(levels: int) -> list[Any]:
    found: list[Any] = []
    for _ in range(levels):
        found = [found]
    return found


def test_a_deadline_goes_on_by_the_calendar_also_where_the_other_clock_began_anew(file: PostsFile) -> None:
    file.posted(Envelope(to=ENGINE, seq=1, reliable=True), 100_000 + 60 * NS, 100_000)
    file.posted(Envelope(to=ENGINE, seq=2, reliable=True), 100_000 - 60 * NS, 100_000)
    file.close()
    again = PostsFile("robot1/mission", ENGINE, 7, 5)
    first, second = (one.until_ns for one in again.kept.waiting)
    assert first is not None and second is not None and 5 < first <= 5 + 60 * NS and second <= 5 - 60 * NS
    again.close()


def test_a_deadline_does_not_grow_when_the_calendar_is_set_back(file: PostsFile, monkeypatch: pytest.MonkeyPatch) -> None:
    file.posted(Envelope(to=ENGINE, seq=1, reliable=True, deadline_ms=10_000), 10 * NS, 0)
    file.close()
    yesterday = time.time() - 86_400
    monkeypatch.setattr("time.time", lambda: yesterday)
    again = opened()
    assert again.kept.waiting[0].until_ns == 10 * NS
    again.close()


def test_a_file_is_written_anew_when_most_of_it_is_over(file: PostsFile, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("failover.drivers.posts_file.TIDY_SIZE", 4_096)
    outbox, sizes = Outbox("robot1/mission", 7), []
    while not sizes or file.path.stat().st_size > sizes[-1]:
        sizes.append(file.path.stat().st_size)
        seq = post(outbox, file)
        outbox.committed()
        outbox.due(0)
        outbox.answered(Envelope(boot=7, seq=seq), 0)
        file.over(seq)
    assert 3_000 < sizes[-1] <= 4_096 and file.path.stat().st_size < 100
    file.close()
    again = opened()
    assert (waiting(again), again.kept.boot) == ([], 8), "a new life"
    again.close()


@contextlib.contextmanager
def full_from(size: int) -> Iterator[None]:
    """No file of this process grows above so many bytes."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_that_a_message_is_over_is_in_the_file_before_the_next_one_although_the_disk_was_full(file: PostsFile) -> None:
    outbox = Outbox("robot1/mission", 7)
    for _ in range(2):
        post(outbox, file)
    with full_from(file.path.stat().st_size):
        file.over(1)
    post(outbox, file)
    file.close()
    again = opened()
    assert waiting(again) == [2, 3]
    again.close()


def test_a_message_that_cannot_be_kept_is_not_taken_and_the_next_one_is(here: Here, kept: Path) -> None:
    with serving(Engine, here) as engine, mission(here) as proxy:
        proxy.call("set", duty=0.1)
        size = next(kept.glob("*.posts")).stat().st_size
        with full_from(size + 50), pytest.raises(DriverError, match="cannot keep what is posted in"):
            proxy.post("set", duty=0.2)
        proxy.call("set", duty=0.3)
        assert engine.instance.heard == [0.1, 0.3]
    with serving(Engine, here), mission(here) as proxy:
        assert proxy.left_over == ()


def test_a_message_that_ctrl_c_keeps_from_the_disk_is_not_taken(here: Here, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(_: int) -> None:
        raise KeyboardInterrupt

    with serving(Engine, here) as engine, mission(here) as proxy:
        proxy.call("set", duty=0.1)
        with monkeypatch.context() as patched:
            patched.setattr("os.fdatasync", interrupted)
            with pytest.raises(KeyboardInterrupt):
                proxy.post("set", duty=0.2)
        proxy.call("set", duty=0.3)
        assert engine.instance.heard == [0.1, 0.3]
    with serving(Engine, here), mission(here) as proxy:
        assert proxy.left_over == ()


def test_a_file_that_was_written_anew_and_interrupted_then_is_written_anew_again(
    file: PostsFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    outbox, rename = Outbox("robot1/mission", 7), os.rename

    def interrupted(old: Path, new: Path) -> None:
        rename(old, new)
        raise KeyboardInterrupt

    post(outbox, file)
    with monkeypatch.context() as patched:
        patched.setattr("os.rename", interrupted)
        with pytest.raises(KeyboardInterrupt):
            file._write_anew()
    post(outbox, file)
    file.close()
    again = opened()
    assert waiting(again) == [1, 2]
    again.close()
