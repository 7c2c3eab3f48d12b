"""Versions are switched and rolled back under 20 Hz of commands from another process: each is carried out once, in order."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from msgspec import UNSET

from failover.core.messaging.envelope import Envelope, decode, encode
from failover.core.messaging.mailbox import SENDERS_MAX
from failover.core.programs import states
from failover.core.programs.states import State
from failover.drivers.route import way_to
from failover.drivers.server import Near, Peer
from failover.errors import BundleRefusedError, CallRefusedError, DriverError, NoAnswerError, ProgramError
from failover.programs.carried import Carried
from failover.programs.channel import State as KeptState
from failover.programs.hosting import Hosting
from failover.programs.running import Running
from failover.programs.sources import Place
from failover.programs.starting import Revival
from failover.programs.store import Kept, Store
from tests.failover.drivers.serving import taking_messages
from tests.failover.drivers.serving import until as wait_for
from tests.failover.programs.senders import NAME, Lab, engine, switched, until

LEAST = 100
RATE_HZ = 20

FAILS_THIRD = """
Engine.calls = getattr(Engine, "calls", 0) + 1
if Engine.calls == 3:
    self.numbers.append(-1)
    raise RuntimeError("the third one")
"""


@contextlib.contextmanager
def sender() -> Iterator[Callable[[], list[int]]]:
    """A process that sends 0, 1, 2 … at 20 Hz, `LEAST` at least; called, it ends and tells the answers."""
    words = [sys.executable, "-m", "tests.failover.programs.senders", "engine", str(RATE_HZ), str(LEAST)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "begun\n"

        def ended() -> list[int]:
            found: list[int] = json.loads(process.communicate()[0])["answers"]
            return found

        try:
            yield ended
        finally:
            process.kill()


def states_of(lab: Lab) -> dict[str, str]:
    return {one.version: str(one.state) for one in lab.store.shelf("engine").versions}


def test_switches_under_20_hz_miss_double_and_reorder_nothing_and_keep_the_state(lab: Lab) -> None:
    for version in ("1", "2", "3"):
        lab.send(version)
    lab.send("4", engine(body=FAILS_THIRD), seconds=60)
    with lab.hosting("1"), sender() as answers, lab.proxy() as proxy:
        for version in ("2", "3"):
            found = switched(proxy, version)
            assert found["active"] == version, found
        found = switched(proxy, "4")
        assert found["active"] == "3" and "the third one" in str(found["said"]), found
        assert "2 commands since then once more" in str(found["said"])
        told = answers()
        assert len(told) >= LEAST and told == list(range(len(told))), "the sender was told about each command, once"
        assert proxy.call("read") == told, "each was carried out once, in order, and is in the state"
    assert states_of(lab) == {"1": "retired", "2": "retired", "3": "active", "4": "rolled back"}


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (FAILS_THIRD, "the third one"),
        ("Engine.calls = getattr(Engine, 'calls', 0) + 1\nif Engine.calls == 3: os._exit(3)", "has ended"),
        (
            "Engine.calls = getattr(Engine, 'calls', 0) + 1\nif Engine.calls == 3:\n  while True: pass",
            "did not answer within 1 s",
        ),
    ],
    ids=["raises", "exits", "hangs"],
)
@pytest.mark.parametrize("on_rollback", ["replay", "newest"])
def test_a_version_that_fails_at_its_third_message_is_rolled_back(lab: Lab, body: str, words: str, on_rollback: str) -> None:
    lab.send("1")
    lab.send("2", engine(body=body), seconds=60, answer_s=1, on_rollback=on_rollback)
    with lab.hosting("1") as host, lab.proxy() as proxy:
        assert [proxy.call("step", number=number) for number in range(3)] == [0, 1, 2]
        proxy.call("_switch", {"version": "2"})
        until(proxy, lambda found: found["active"] == "2")
        assert [proxy.call("step", number=number, timeout=60) for number in range(3, 8)] == [3, 4, 5, 6, 7]
        assert proxy.call("read") == list(range(8))
        found = proxy.call("_versions")
        assert found["active"] == "1" and words in found["said"]
        assert ("with the state of 2" in found["said"]) == (on_rollback == "newest")
        assert states_of(lab) == {"1": "active", "2": "rolled back"}
        assert host.service.record.versions == ("1",)


def test_the_new_version_reads_the_old_ones_state_by_its_migration(lab: Lab) -> None:
    terms = "version=2, migrations={1: lambda state: {'told': [n * 10 for n in state['numbers']]}}"
    lab.send("1")
    lab.send("2", engine(kept="told: list[int] = failover.kept(default=[])", numbers="told", terms=terms), seconds=0)
    with lab.hosting("1"), lab.proxy() as proxy:
        proxy.call("step", number=1)
        assert switched(proxy, "2")["active"] == "2"
        proxy.call("step", number=2)
        assert proxy.call("read") == [10, 2]
        with pytest.raises(CallRefusedError, match="cannot read the state of 2"):
            proxy.call("_rollback")
        assert proxy.call("read") == [10, 2], "a rollback that cannot be leaves all as it was"
        assert proxy.call("_rollback", {"old_state": True}) == {"active": "1"}
        assert proxy.call("read") == [1]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("raise ImportError('nothing such')", "ImportError: nothing such"),
        ("Engine = 3", "has no class Engine"),
        ("import os; os._exit(1)", "has ended"),
        (engine().replace("Lab/robot1/Engine", "Lab/robot1/Other"), "speaks for Lab/robot1/Other"),
        (engine(kept="numbers: list[str] = failover.kept(default=[])"), "numbers"),
        (engine(kept="numbers: list[int] = failover.kept(default=[])\n    def __init__(self): 1 / 0"), "ZeroDivisionError"),
    ],
    ids=["import", "class", "exit", "path", "state", "init"],
)
def test_a_version_that_cannot_begin_leaves_the_old_one_as_it_was(lab: Lab, text: str, words: str) -> None:
    lab.send("1")
    lab.send("2", text)
    with lab.hosting("1"), lab.proxy() as proxy:
        proxy.call("step", number=7)
        found = switched(proxy, "2")
        assert found["active"] == "1" and words in str(found["said"]), found
        assert proxy.call("step", number=8) == 8 and proxy.call("read") == [7, 8]
    assert states_of(lab) == {"1": "active", "2": "staged"}


def test_a_health_query_that_fails_rolls_back_and_one_that_answers_commits(lab: Lab) -> None:
    lab.send("1")
    lab.send("2", engine(extra="raise RuntimeError('no wings')"), query="fly")
    lab.send("3", engine(), query="fly", messages=2)
    with lab.hosting("1"), lab.proxy() as proxy:
        found = switched(proxy, "2")
        assert found["active"] == "1" and "no wings" in str(found["said"])
        proxy.call("_switch", {"version": "3"})
        assert until(proxy, lambda found: found["active"] == "3")["on_trial"], "it has carried out no message yet"
        assert [proxy.call("step", number=number) for number in range(2)] == [0, 1]
        until(proxy, lambda found: not found["on_trial"])
        shelf = lab.store.shelf("engine")
        assert shelf.floor == "3" and shelf.active is not None and shelf.active.is_committed


def test_mailbox_and_state_outlive_the_host_and_its_version(lab: Lab) -> None:
    lab.send("1")
    with lab.hosting() as host, lab.proxy() as proxy:
        assert [proxy.call("step", number=number) for number in range(3)] == [0, 1, 2]
        process = host.actor._running._process  # type: ignore[union-attr]
        process.kill()
        process.wait()  # a command that it has in hand would be answered with an error
        assert proxy.call("step", number=3, timeout=60) == 3
        assert proxy.call("read", timeout=60) == [0, 1, 2, 3]
    with lab.hosting() as host, lab.proxy() as proxy:
        assert proxy.call("read") == [0, 1, 2, 3]


SLOW = """
import os, pathlib, time
place = pathlib.Path({place!r})
if (place / "slow").exists():
    (place / "loading").touch()
    while (place / "slow").exists():
        time.sleep(0.01)
"""


def test_while_a_lost_version_is_started_anew_the_host_answers_and_refuses_with_a_sentence(lab: Lab) -> None:
    first = lab.source("1", engine(before=SLOW.format(place=str(lab.folder))))
    second = lab.source("2", seconds=0)
    hosting = taking_messages(Hosting(Place(lab.store, lab.team, "engine", first), "", lab.here))
    with hosting as host, lab.proxy() as proxy:
        assert proxy.call("step", number=0) == 0
        (lab.folder / "slow").touch()
        process = host.actor._running._process  # type: ignore[union-attr]
        process.kill()
        until(proxy, lambda found: not found["active"] and (lab.folder / "loading").exists())
        assert [proxy.call("_describe")["path"], proxy.call("_graph")[0]["verb"]] == ["Lab/robot1/Engine", "step"]
        with pytest.raises(NoAnswerError, match="busy: engine 1 is being started anew: its process ended; send it again"):
            proxy.call("step", number=1, timeout=0.2)
        assert proxy.call("_versions")["active"] == "", "its import still goes on"
        (lab.folder / "slow").unlink()
        assert proxy.call("step", number=2, timeout=60) == 2 and proxy.call("read") == [0, 2]
        (lab.folder / "slow").touch()
        (lab.folder / "loading").unlink()
        host.actor._running._process.kill()  # type: ignore[union-attr]
        until(proxy, lambda found: not found["active"] and (lab.folder / "loading").exists())
        proxy.call("_switch", {"directory": str(second)})
        until(proxy, lambda found: found["active"] == "2")  # it need not wait for the lost one
        assert proxy.call("step", number=3, timeout=60) == 3 and proxy.call("read") == [0, 2, 3]
        (lab.folder / "slow").touch()  # and the host's end does not wait either


RESUMES = """numbers: list[int] = failover.kept(default=[])
    told = "nothing"
    def on_resume(self, resumed):
        self.told = [resumed.why, resumed.robot, resumed.age_s >= 0, list(self.numbers), list(resumed.notes)]"""


def test_a_version_that_begins_with_a_kept_state_is_told_where_it_comes_from(lab: Lab) -> None:
    text = engine(kept=RESUMES, extra="return self.told")
    lab.send("1", text)
    lab.send(
        "2", text.replace("failover.kept(default=[])", "failover.kept(default=[])\n    more: int = failover.kept(default=7)")
    )
    with lab.hosting("1") as host, lab.proxy() as proxy:
        assert proxy.call("fly") == "nothing", "its state begins here"
        proxy.call("step", number=1)
        host.actor._running._process.kill()  # type: ignore[union-attr]
        host.actor._running._process.wait()  # type: ignore[union-attr]
        assert proxy.call("fly", timeout=60) == ["restarted", "robot1", True, [1], []]
        switched(proxy, "2")
        why, _, _, numbers, notes = proxy.call("fly")
        assert (why, numbers) == ("switched", [1]) and "more" in notes[0]
    with lab.hosting(), lab.proxy() as proxy:
        assert proxy.call("fly")[0] == "restarted"


def test_a_host_that_ends_during_a_trial_goes_back(lab: Lab) -> None:
    lab.send("1")
    lab.send("2", seconds=600)
    with lab.hosting("1"), lab.proxy() as proxy:
        proxy.call("step", number=1)
        proxy.call("_switch", {"version": "2"})
        until(proxy, lambda found: found["active"] == "2")
        proxy.call("step", number=2)
    with lab.hosting(), lab.proxy() as proxy:
        assert proxy.call("_versions")["active"] == "1" and proxy.call("read") == [1, 2]
    assert states_of(lab) == {"1": "active", "2": "rolled back"}


def test_a_host_that_ends_between_the_shelf_and_the_switch_goes_on_with_the_old_version_and_its_newest_state(lab: Lab) -> None:
    lab.send("1")
    with lab.hosting("1"), lab.proxy() as proxy:
        proxy.call("step", number=1)
    lab.send("2", engine(kept="numbers: list[str] = failover.kept(default=[])"))
    shelf = lab.store.shelf("engine")
    lab.store.put(states.succeed(shelf, states.warm(shelf.find("2")), "on trial"))  # type: ignore[arg-type]
    with lab.hosting(), lab.proxy() as proxy:
        assert proxy.call("_versions")["active"] == "1" and proxy.call("read") == [1]
    assert states_of(lab) == {"1": "active", "2": "rolled back"}


def test_no_file_is_written_while_no_version_can_take_a_message(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.send("1")
    lab.send("2", seconds=0)
    said: list[str] = []

    def noted(owner: object, name: str) -> None:
        real = getattr(owner, name)

        def called(*arguments: Any, **named: Any) -> Any:
            said.append(name)
            return real(*arguments, **named)

        monkeypatch.setattr(owner, name, called)

    with lab.hosting("1"), lab.proxy() as proxy:
        for owner, names in ((Running, ("pause", "begin", "end")), (Store, ("put", "keep", "settle", "log"))):
            for name in names:
                noted(owner, name)
        assert switched(proxy, "2")["active"] == "2"
        until(proxy, lambda _: said.count("put") > 1)
        first = said.index("pause")
        assert "put" in said[:first] and said[first : first + 2] == ["pause", "begin"], said
        assert {"keep", "log"} <= set(said[first + 2 :]) and not {"settle", "end"} & set(said[: first + 2]), said


def test_a_switch_that_cannot_be_recorded_leaves_the_old_version_untouched(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.send("1", engine(kept=RESUMES, extra="return self.told"))
    lab.send("2")

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with lab.hosting("1"), lab.proxy() as proxy:
        with monkeypatch.context() as patch:
            patch.setattr(Store, "put", full)
            found = switched(proxy, "2")
        assert found["active"] == "1" and "No space left on device" in str(found["said"]), found
        assert proxy.call("fly") == "nothing", "it was neither paused nor begun again"
    assert states_of(lab) == {"1": "active", "2": "staged"}


def test_two_versions_run_side_by_side_under_two_names(lab: Lab) -> None:
    lab.send("1")
    lab.send("2", engine(body="number = number * 2"))
    with lab.hosting("1"), lab.hosting("2", beside=True), lab.proxy() as one, lab.proxy("Lab/robot1/Engine@2") as two:
        assert one.call("step", number=5) == 5 and two.call("step", number=5) == 10
        assert one.call("read") == [5] and two.call("read") == [10]


def test_the_right_counts_when_a_version_becomes_active_and_not_only_when_it_came(lab: Lab) -> None:
    lab.send("1")
    lab.send("2")
    with lab.hosting("1"), lab.proxy() as proxy:
        (lab.team / "rights.toml").write_text("")
        found = switched(proxy, "2")
        assert found["active"] == "1" and "may not program" in str(found["said"]), found
        lab.trust(until="2020-01-01")
        assert "expired on 2020-01-01" in str(switched(proxy, "2")["said"])
    with pytest.raises(BundleRefusedError, match="expired"), lab.hosting():
        raise AssertionError("it must not start")


def test_files_that_were_changed_after_they_came_do_not_run(lab: Lab) -> None:
    digest = lab.send("1").digest
    path = lab.store.tree(digest) / "engine.py"
    path.chmod(0o644)
    path.write_text("raise SystemExit")
    with pytest.raises(ProgramError, match="was changed since it was unpacked"), lab.hosting():
        raise AssertionError("it must not start")


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({}, "say which"),
        ({"version": "9"}, "is not here, but 1, 2"),
        ({"version": "x"}, "is no version"),
        ({"version": "2"}, "active already"),
        ({"version": "1"}, "is older than 2"),
        ({"directory": "/"}, "say which"),
    ],
)
def test_an_order_that_cannot_be_is_refused_with_a_sentence(lab: Lab, body: dict[str, str], words: str) -> None:
    lab.send("1")
    lab.send("2")
    with lab.hosting("2"), lab.proxy() as proxy:
        with pytest.raises(CallRefusedError, match=words):
            proxy.call("_switch", body)
        with pytest.raises(CallRefusedError, match="cannot be rolled back"):
            proxy.call("_rollback")
        assert proxy.call("_versions")["active"] == "2"
    assert lab.store.shelf("engine").versions[0].state is State.STAGED


def test_an_order_counts_by_the_way_it_came_also_when_that_way_is_forgotten(lab: Lab) -> None:
    lab.send("1")
    order = Envelope("engine", "_rollback", id="order", sender="robot2/x")
    with Hosting(Place(lab.store, lab.team, "engine"), "1", lab.here) as host:

        def sentence(whose: Peer | Near) -> str:
            found = host.actor.came(order, whose, host.now_ns())
            for number in range(SENDERS_MAX + 1):
                host.actor.came(Envelope("nobody", sender=f"robot2/{number}"), Peer(b"x", ""), host.now_ns())
            answers = [*found, *host.actor.handle(host.now_ns)]
            return next(one.error.sentence for one in answers if one.re == "order")  # type: ignore[union-attr]

        assert sentence(Peer(b"x", "")) == "give this order on the robot itself: robot2/x is on another one"
        assert "uid 54321 is neither" in sentence(Near(9, 1, 54_321))
        assert "cannot be rolled back" in sentence(Near(9, 2, os.geteuid()))


def test_what_was_kept_last_outlives_a_full_disk(lab: Lab) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    for number in (1, 2):
        lab.store.keep("Lab/robot1/Engine", Kept(number, "1", KeptState(b"x" * number), {}))
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (64, before[1]))
        for number in (3, 4):
            with pytest.raises(ProgramError, match="cannot keep the state"):
                lab.store.keep("Lab/robot1/Engine", Kept(number, "1", KeptState(b"x" * 4_096), {}))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    found = lab.store.kept("Lab/robot1/Engine")
    assert found is not None and found.number == 2


def test_a_second_host_of_a_program_is_refused_and_ends_no_trial_of_the_first(lab: Lab) -> None:
    lab.send("1")
    lab.send("2", seconds=600)
    with lab.hosting("1"), lab.proxy() as proxy:
        proxy.call("_switch", {"version": "2"})
        until(proxy, lambda found: found["active"] == "2")
        before = states_of(lab)
        with pytest.raises(DriverError, match="is the driver of Lab/robot1/Engine on this robot already"):
            Hosting(Place(lab.store, lab.team, "engine"), "", lab.here)
        assert states_of(lab) == before


def test_a_bundle_that_comes_again_brings_its_newer_signature_and_mends_its_files(lab: Lab) -> None:
    source = lab.source("1")
    digest = lab.store.take(lab.bundle(source, int(time.time()) + 3_600), lab.team).program.digest
    (lab.store.tree(digest) / "engine.py").unlink()
    with pytest.raises(ProgramError, match="was changed since it was unpacked; send the bundle again"):
        lab.store.admitted(digest, lab.team)
    again = lab.bundle(source, int(time.time()) + 7_200)
    lab.store.take(again, lab.team)
    assert lab.store.tree(digest).with_suffix(".bundle").read_bytes() == again
    assert lab.store.admitted(digest, lab.team).program.digest == digest


def test_a_directory_that_no_file_can_have_is_refused_with_a_sentence(lab: Lab) -> None:
    place = Place(lab.store, lab.team, "engine", lab.source("1"))
    with Hosting(place, "", lab.here) as host:
        order = Envelope("engine", "_switch", {"directory": "a\0"}, sender="robot1/x")
        (answer,) = [*host.actor.came(order, Near(9, 1, 0), host.now_ns()), *host.actor.handle(host.now_ns)]
        assert answer.error is not UNSET and answer.error.kind == "refused"


def test_with_a_version_end_the_processes_that_it_started_after_it_let_its_device_go(lab: Lab) -> None:
    retired = lab.folder / "retired"
    kept = f"numbers: list[int] = failover.kept(default=[])\n    def on_retire(self): open({str(retired)!r}, 'w').close()"
    before = "import subprocess\nhelper = subprocess.Popen(['sleep', '1000'])"
    second = lab.source("2", engine(kept=kept, before=before, extra="return helper.pid"))
    with Hosting(Place(lab.store, lab.team, "engine", lab.source("1")), "", lab.here) as host:
        thread = threading.Thread(target=host.serve)
        thread.start()
        with lab.proxy() as proxy:
            proxy.call("_switch", {"directory": str(second)})
            until(proxy, lambda found: found["active"] == "2")
            helper = Path(f"/proc/{proxy.call('fly')}")
            assert "sleep" in (helper / "cmdline").read_text() and not retired.exists()
        host.stop()
        thread.join()
    assert retired.exists()
    deadline = time.monotonic() + 60
    while helper.exists() and "\nState:\tZ" not in (helper / "status").read_text():  # a zombie where no init reaps it
        assert time.monotonic() < deadline, "the helper process goes on"
        time.sleep(0.01)


def test_a_host_that_gets_no_process_says_so_and_goes_on(lab: Lab) -> None:
    with Hosting(Place(lab.store, lab.team, "engine", lab.source("1")), "", lab.here) as host:
        source = host.actor._last
        before = resource.getrlimit(resource.RLIMIT_NOFILE)
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (3, before[1]))
            with pytest.raises(ProgramError, match="the system gives no process: Too many open files"):
                Running(source)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, before)


def test_a_version_that_may_not_run_any_more_is_not_started_anew_either(lab: Lab) -> None:
    lab.send("1")
    with lab.hosting() as host, lab.proxy() as proxy:
        proxy.call("step", number=1, timeout=60)
        (lab.team / "programs.toml").write_text("")
        os.kill(host.actor._running.pid, signal.SIGKILL)  # type: ignore[union-attr]
        until(proxy, lambda found: "it cannot be started anew: the bundle is signed by the key" in str(found["said"]))
        lab.trust()
        until(proxy, lambda found: found["active"] == "1")
        assert proxy.call("read", timeout=60) == [1]


def test_a_result_that_no_message_can_carry_is_refused_and_ends_no_version(lab: Lab) -> None:
    lab.send("1", engine(extra="return 'x' * 1_100_000"))
    with lab.hosting() as host, lab.proxy() as proxy:
        pid = host.actor._running.pid  # type: ignore[union-attr]
        with pytest.raises(CallRefusedError, match="1048576 at most") as refused:
            proxy.call("fly", timeout=60)
        assert refused.value.kind == "bad_result"
        assert proxy.call("step", number=1, timeout=60) == 1 and host.actor._running.pid == pid  # type: ignore[union-attr]


def test_a_host_that_is_fenced_starts_and_switches_nothing_until_it_acts_again(lab: Lab) -> None:
    lab.send("1")
    with lab.hosting() as host, lab.proxy() as proxy:
        proxy.call("step", number=1, timeout=60)
        actor, acts = host.actor, host.actor.fence
        actor.fence = lambda _: "it runs elsewhere"
        lost = actor._running
        assert lost is not None
        lost._process.kill()
        lost._process.wait()
        turns: list[int] = []
        handle = actor.handle
        actor.handle = lambda clock: turns.append(1) or handle(clock)  # type: ignore[method-assign, func-returns-value]
        for count in range(1, 4):
            host.wake()
            wait_for(lambda count=count: len(turns) >= count)  # type: ignore[misc]
        assert actor._running is lost and not actor._starter.is_reviving
        actor._starter._revival = Revival(None)
        assert actor.wait_ns(host.now_ns()), "nor does it spin over what it does not do"
        actor._starter._revival, actor.fence = None, acts
        host.wake()
        assert proxy.call("read", timeout=60) == [1] and actor._running is not lost


def test_what_expires_while_no_version_runs_is_answered_at_once(lab: Lab) -> None:
    lab.send("1")
    with lab.hosting() as host, lab.proxy() as proxy:
        (lab.team / "programs.toml").write_text("")
        host.actor._running._process.kill()  # type: ignore[union-attr]
        until(proxy, lambda found: "cannot be started anew" in str(found["said"]))
        way = way_to(lab.here, proxy._sending.route.address, "robot1")
        late = Envelope(verb="step", body=1, sender="robot1/s", boot=1, seq=1, reliable=True, deadline_ms=0)
        assert way.await_sent(encode(late), 60 * 10**9)
        said = decode(way.await_message(10 * 10**9) or b"")
        assert said.error is not UNSET and said.error.kind == "expired"
        way.close()


FORGES = """
import __main__
import msgspec
from failover.core.messaging import envelope as e

def forged(said, encoding="json"):
    terms = {"error": e.Fault("moved", "go away")} if isinstance(said.ok, list) else {}
    return e.encode(msgspec.structs.replace(said, to="robot1/x", re="y", boot=7, seq=99, epoch=1 << 50, **terms), encoding)

e.encode_answer = forged
"""


def test_a_version_says_what_came_of_a_message_and_nothing_else_of_its_answer(lab: Lab) -> None:
    lab.send("1", engine(before=FORGES))
    with lab.hosting(), lab.proxy() as proxy:
        assert proxy.call("step", number=1, timeout=20) == 1
        assert proxy.last is not None and proxy.last.epoch == 0
        with pytest.raises(CallRefusedError, match="go away") as refused:
            proxy.call("read", timeout=20)
        assert refused.value.kind == "failed"


RATES = """
import __main__
import msgspec

hello = __main__.Loaded.hello

def told(self):
    found = hello(self)
    verbs = {name: msgspec.structs.replace(one, role="stream", rate_hz=0.0) for name, one in found.verbs.items()}
    return msgspec.structs.replace(found, **(RATES))

__main__.Loaded.hello = told
"""


@pytest.mark.parametrize("rates", ["{'rate_hz': 0.0}", "{'rate_hz': float('nan')}", "{'verbs': verbs}"])
def test_a_version_that_tells_no_rate_is_refused(lab: Lab, rates: str) -> None:
    lab.send("1", engine(before=RATES.replace("RATES", rates)))
    with pytest.raises(ProgramError, match="is no rate in Hz"), lab.hosting():
        pass


def test_what_a_trial_has_answered_is_kept_until_the_version_before_it_has_carried_it_out(lab: Lab) -> None:
    lab.send("1")
    lab.send("2", engine(body=FAILS_THIRD), seconds=600)
    with lab.hosting("1") as host, lab.proxy() as proxy:
        proxy.call("step", number=0, timeout=60)
        proxy.call("_switch", {"version": "2"})
        until(proxy, lambda found: found["active"] == "2")
        assert [proxy.call("step", number=number, timeout=60) for number in (1, 2)] == [1, 2]
        host.actor._old._process.kill()  # type: ignore[union-attr]
        host.actor._old._process.wait()  # type: ignore[union-attr]
        before = lab.store.kept(NAME)
        (lab.team / "programs.toml").write_text("")
        with pytest.raises(CallRefusedError):
            proxy.call("step", number=3, timeout=60)
        until(proxy, lambda found: "cannot be started anew" in str(found["said"]))
        kept = lab.store.kept(NAME)
        assert kept is not None and before is not None
        assert (kept.version, kept.state) == ("2", before.state), "the two commands are in it, and count as answered"
        lab.trust()
        until(proxy, lambda found: found["active"] == "1")
        assert proxy.call("read", timeout=60) == [0, 1, 2]
    kept = lab.store.kept(NAME)
    assert kept is not None and kept.version == "1"


def test_a_shelf_that_a_standby_could_not_get_goes_to_it_with_a_later_message(lab: Lab) -> None:
    digest = lab.send("1").digest
    with lab.hosting() as host, lab.proxy():
        keeping: Any = SimpleNamespace(instance=Carried())
        bundle = lab.store._bundle(digest)
        bundle.rename(bundle.with_suffix(".aside"))
        host.actor._carry(keeping)
        assert not keeping.instance.shelf and "a standby cannot take 1 over" in host.actor._said
        bundle.with_suffix(".aside").rename(bundle)
        host.actor._carry(keeping)
        assert keeping.instance.shelf and list(keeping.instance.bundles) == [digest]
