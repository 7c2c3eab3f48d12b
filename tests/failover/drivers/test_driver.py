"""A driver on one robot, called over real sockets."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from msgspec import UNSET

import failover
from failover.core.messaging import avro
from failover.core.messaging import envelope as envelopes
from failover.core.messaging.envelope import Encoding
from failover.core.messaging.mailbox import MAILBOX_MAX
from failover.core.naming.tree import Reach
from failover.drivers import here as here_module
from failover.drivers.exchange import Exchange
from failover.drivers.here import Here, lives, stem
from failover.drivers.local import LocalWay, Poller
from failover.drivers.lookup import lookup, whole_tree
from failover.drivers.proxy import Proxy
from failover.drivers.server import Serving
from failover.errors import CallRefusedError, DriverError, EnvelopeError, NameUnknownError, NoAnswerError
from tests.failover.drivers.devices import DEVICE_HZ, ENGINE, Arm, Engine, Slow
from tests.failover.drivers.serving import LIMIT_S, called, serving, until

ROOT = Path(__file__).parents[3]


@pytest.fixture
def engine(here: Here) -> Iterator[Serving]:
    with serving(Engine, here) as one:
        yield one


@pytest.mark.parametrize("name", ["engine", ENGINE, f"/{ENGINE}", ENGINE.replace("/", " → ")])
def test_each_kind_of_name_leads_to_the_driver(engine: Serving, here: Here, name: str) -> None:
    with called(here, name) as proxy:
        assert proxy.call("set", duty=0.4) is None
        assert proxy.call("read") == {"duty": 0.4}
        assert proxy.call("set", {"duty": 0.5}) is None and proxy.call("set", 0.6) is None
    assert engine.instance.heard == [0.4, 0.5, 0.6]


@pytest.mark.parametrize(
    ("verb", "body", "kind", "words"),
    [
        ("fly", None, "unknown_verb", "has no verb 'fly'; it has set, stall, read"),
        ("set", {"duty": 2}, "bad_body", "<= 1"),
        ("set", {"duty": "much"}, "bad_body", "Expected `float`"),
        ("set", {"dutty": 0.1}, "bad_body", "unknown field `dutty`"),
        ("set", None, "bad_body", "missing required field `duty`"),
        ("set", {"duty": 0.1, "speed": 3}, "bad_body", "unknown field `speed`"),
        ("stall", None, "failed", "RuntimeError: the bridge is hot"),
        ("odd", None, "bad_result", "object is no value of JSON"),
        ("huge", None, "bad_result", "2^53"),
        ("_nothing", None, "unknown_verb", "_nothing"),
    ],
)
def test_what_cannot_be_done_is_told_and_the_driver_goes_on(
    engine: Serving, here: Here, verb: str, body: Any, kind: str, words: str
) -> None:
    with called(here, "engine") as proxy:
        with pytest.raises(CallRefusedError) as refused:
            proxy.call(verb, body)
        assert refused.value.kind == kind and words in str(refused.value)
        assert proxy.call("read") == {"duty": 0.0}


def test_a_stream_comes_until_it_is_left_and_not_after(engine: Serving, here: Here) -> None:
    with called(here, "engine") as proxy:
        proxy.call("set", duty=0.5)
        values = proxy.stream("current")
        assert [next(values) for _ in range(5)] == [1.0] * 5
        values.close()  # type: ignore[attr-defined]
        until(lambda: not engine._actor._subscribers)
        with pytest.raises(CallRefusedError, match="no stream 'read'"):
            next(proxy.stream("read"))


def test_messages_of_one_sender_are_handled_in_order_while_others_send(engine: Serving, here: Here) -> None:
    def send(sign: int) -> None:
        with called(here, "engine") as proxy:
            for number in range(1, 101):
                proxy.call("set", duty=sign * number / 100, timeout=LIMIT_S)

    threads = [threading.Thread(target=send, args=(sign,)) for sign in (1, -1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    heard = engine.instance.heard
    assert [value for value in heard if value > 0] == [number / 100 for number in range(1, 101)]
    assert [-value for value in heard if value < 0] == [number / 100 for number in range(1, 101)]


def test_a_large_message_and_a_large_answer_come_whole(engine: Serving, here: Here) -> None:
    from failover.core.messaging.envelope import Envelope, decode, encode
    from failover.drivers.route import way_to

    way = way_to(here, engine.service.record.addresses[0], "robot1")
    asked = Envelope(to="engine", verb="read", id="1", sender="test", rest={"note": "x" * 900_000})
    assert way.await_sent(encode(asked), 10**9)
    answer = way.await_message(LIMIT_S * 10**9)
    assert answer is not None and decode(answer).ok == {"duty": 0.0}
    too_large = (1 << 21).to_bytes(4, "big")
    with socket.socket(socket.AF_UNIX) as raw:
        raw.settimeout(LIMIT_S)
        raw.connect(str(here.file(ENGINE, "calls")))
        raw.sendall(too_large)
        assert raw.recv(1) == b""  # and the driver goes on
    assert way.await_sent(encode(asked), 10**9) and way.await_message(LIMIT_S * 10**9) is not None
    way.close()


@pytest.mark.parametrize("encoding", ["json", "msgpack", "avro"])
def test_a_message_is_answered_in_its_encoding(engine: Serving, here: Here, encoding: Encoding) -> None:
    if encoding == "avro":
        pytest.importorskip("fastavro", reason="needs fastavro: the extra avro")
    with Proxy(here, lookup(here, "engine"), encoding=encoding) as proxy:
        came = noted_answers(proxy)
        assert proxy.call("set", duty=0.5) is None and proxy.call("read") == {"duty": 0.5}
        with pytest.raises(CallRefusedError, match="<= 1"):
            proxy.call("set", duty=2)
        assert {envelopes.encoding_of(one) for one in came} == {encoding} and len(came) >= 3
        assert next(proxy.stream("current")) == 1.0
        assert encoding in engine._encodings.values() or encoding == "json", "the stream is asked for in it, too"


def noted_answers(proxy: Proxy) -> list[bytes]:
    """What comes to a proxy, as bytes."""
    way, came = proxy._sending.route.way, []
    await_message = way.await_message

    def noted(*arguments: Any) -> bytes | None:
        found = await_message(*arguments)
        came.extend([found] if found is not None else [])
        return found

    way.await_message = noted  # type: ignore[method-assign]
    return came


def test_a_driver_that_cannot_read_an_encoding_gets_json(engine: Serving, here: Here, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("fastavro", reason="needs fastavro: the extra avro")

    def missing(_: bytes) -> Any:
        raise EnvelopeError("the message is Avro, and the library fastavro is not installed here")

    monkeypatch.setattr(envelopes, "_from_avro", missing)
    with Proxy(here, lookup(here, "engine"), encoding="avro") as proxy:
        came = noted_answers(proxy)
        assert proxy.call("read", timeout=LIMIT_S) == {"duty": 0.0} and proxy.post("read").result(LIMIT_S) == {"duty": 0.0}
    refused = [envelopes.decode(one).error is not UNSET for one in came]
    assert refused[0] and not refused[-1], "one is refused, then all is JSON"


@pytest.mark.parametrize(("encoding", "words"), [("xml", "write one of json, msgpack, avro"), ("avro", "failover\\[avro\\]")])
def test_an_encoding_that_cannot_be_sent_is_refused(
    engine: Serving, here: Here, encoding: Any, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "fastavro", None)
    avro._library.cache_clear()
    with pytest.raises(DriverError, match=words):
        Proxy(here, lookup(here, "engine"), encoding=encoding)


def test_a_driver_that_hangs_holds_no_caller_longer_than_its_timeout(here: Here) -> None:
    with socket.socket(socket.AF_UNIX) as hanging:
        place = here.file("Lab/Hangs", "calls")
        hanging.bind(str(place))
        hanging.listen()
        way = LocalWay(str(place))
        content = b"x" * (1 << 20)
        assert not way.await_sent(content, 1_000_000_000) and way.is_lost
        way.close()


# --- By hand ---------------------------------------------------------------------------------------------------------


def by_hand(path: Path, text: str, answers: int = 1) -> list[dict[str, Any]]:
    """What a driver answers to what is typed into ``nc -U``."""
    with socket.socket(socket.AF_UNIX) as typing:
        typing.settimeout(LIMIT_S)
        typing.connect(str(path))
        typing.sendall(text.encode())
        typing.shutdown(socket.SHUT_WR)
        lines = typing.makefile().read().splitlines()
    assert len(lines) == answers
    return [json.loads(line) for line in lines]


def test_three_lines_by_hand_move_the_engine(engine: Serving, here: Here) -> None:
    text = '{"to": "engine",\n "verb": "set",\n "body": {"duty": 0.4}}\n'
    (answer,) = by_hand(here.file(ENGINE, "hand"), text)
    assert answer["ok"] is None and engine.instance.duty == 0.4


def test_several_messages_over_one_connection_are_answered_in_order(engine: Serving, here: Here) -> None:
    text = '{"verb":"set","body":0.1,"id":"a"} {"id":"b","verb":"read"}\n{"verb":"fly","id":"c"}'
    one, two, three = by_hand(here.file(ENGINE, "hand"), text, answers=3)
    assert (one["re"], two["re"], two["ok"], three["error"]["kind"]) == ("a", "b", {"duty": 0.1}, "unknown_verb")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("GET / HTTP/1.1\r\n\r\n", "a message begins with {"),
        ('{"verb": "set", "verb": "read"}', "'verb' twice"),
        ('{"verb": 3}', "another kind"),
        ('{"to": "arm", "verb": "read"}', "this is Lab/Robotino/Engines/3/PWM, and not arm"),
        ('{"verb": "set", "body": ' + "[" * 100 + "]" * 100 + "}", "deeper than 32"),
        ("{" + "\xff" * 9 + "}", "cannot be read"),
    ],
)
def test_nonsense_by_hand_is_answered_with_one_sentence(engine: Serving, here: Here, text: str, words: str) -> None:
    (answer,) = by_hand(here.file(ENGINE, "hand"), text)
    assert words in answer["error"]["sentence"] and engine.instance.heard == []
    with called(here, "engine") as proxy:
        assert proxy.call("read") == {"duty": 0.0}


# --- Pace ------------------------------------------------------------------------------------------------------------


def test_a_slow_device_gets_its_pace_and_each_sender_is_told_what_became_of_its_commands(here: Here) -> None:
    """Offered as fast as they can be written; the device takes 20 a second."""
    count = 40
    lines = "".join(json.dumps({"verb": "move", "body": {"xy"[n % 2]: n}, "id": f"m{n}"}) + "\n" for n in range(count))
    with serving(Slow, here) as slow:
        answers = by_hand(here.file("Lab/Robotino/Slow", "hand"), lines, answers=count)
        assert slow.instance.values == {"x": count - 2, "y": count - 1}
        carried = [one for one in answers if one["ok"] is None]
        into = [one["ok"]["merged_into"] for one in answers if one["ok"] is not None]
        assert len(carried) == len(slow.instance.seen) and len(into) == count - len(carried)
        assert len(carried) < count / 2 and set(into) <= {one["re"] for one in carried}
        assert [one["re"] for one in answers] == [f"m{n}" for n in range(count)]


def test_commands_that_may_not_merge_are_all_carried_out_in_order(here: Here) -> None:
    text = "".join(f'{{"verb":"step","body":{n}}} {{"verb":"move","body":{{"x":{n}}}}}\n' for n in range(6))
    with serving(Slow, here) as slow:
        by_hand(here.file("Lab/Robotino/Slow", "hand"), text, answers=12)
        steps = [value for verb, value in slow.instance.seen if verb == "step"]
        assert steps == list(range(6)) and [verb for verb, _ in slow.instance.seen] == ["step", "move"] * 6
        assert all(later - earlier > 0.95 / DEVICE_HZ for earlier, later in itertools.pairwise(slow.instance.starts))


def test_a_full_mailbox_refuses_and_loses_nothing_that_it_took(engine: Serving, here: Here) -> None:
    engine.instance.gate.clear()
    count = MAILBOX_MAX + 200
    lines = "".join('{"verb":"set","body":0.5}\n' for _ in range(count))
    timer = threading.Timer(0.5, engine.instance.gate.set)
    timer.start()
    answers = by_hand(here.file(ENGINE, "hand"), lines, answers=count)
    timer.join()
    busy = [one for one in answers if one.get("error", {}).get("kind") == "busy"]
    assert len(engine.instance.heard) == count - len(busy)


# --- Names -----------------------------------------------------------------------------------------------------------


def test_drivers_find_each_other_by_the_scan_alone(here: Here) -> None:
    with serving(Engine, here) as engine, serving(Arm, here) as arm:
        until(lambda: "engine" in str(resolved(arm, "engine")) and resolved(engine, "arm"))
        assert resolved(arm, "engine").record.path == ENGINE
        assert [place.record.path for place in whole_tree(here).under()] == ["Lab/Robotino/Arm", ENGINE]
    assert [path.name for path in here.directory.iterdir() if path.suffix in (".names", ".calls", ".hand")] == []


def resolved(one: Serving, name: str) -> Any:
    with contextlib.suppress(NameUnknownError):
        return one.service.resolve(name)


def test_a_driver_that_ends_withdraws_its_name(here: Here) -> None:
    with serving(Arm, here) as arm:
        with serving(Engine, here):
            until(lambda: resolved(arm, "engine"))
        until(lambda: not resolved(arm, "engine"))
        with pytest.raises(NameUnknownError, match="'engine' names nothing"):
            lookup(here, "engine")


def test_a_name_service_without_a_descriptor_left_finds_its_neighbours_later(here: Here) -> None:
    """Its thread goes on: else the driver has lost its name for good."""
    with contextlib.closing(Exchange(here, "a.names")) as one, contextlib.closing(Exchange(here, "b.names")):
        assert [path.name for path in one.neighbours()] == ["b.names"]
        limits = resource.getrlimit(resource.RLIMIT_NOFILE)
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (3, limits[1]))
            assert one.neighbours() == [] and one.lost == 1
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
        assert [path.name for path in one.neighbours()] == ["b.names"]


def test_without_a_driver_the_sentence_says_so(here: Here) -> None:
    with pytest.raises(NameUnknownError, match=r"no driver runs on robot1 for this user, and other robots are not reached"):
        lookup(here, "engine")


def test_a_path_has_one_process(engine: Serving, here: Here) -> None:
    with pytest.raises(DriverError, match=f"pid {os.getpid()} is the driver of {ENGINE}"):
        Serving(Engine, here)
    with called(here, "engine") as proxy:
        assert proxy.call("read") == {"duty": 0.0}


def test_files_of_two_paths_are_never_the_same(folder: Path) -> None:
    paths = ["a/b", "a.b", "a/" + "b" * 180, "a/" + "b" * 181, "ä/" + "ö" * 90, "a/b.c", "a.b/c"]
    stems = [stem(path, folder) for path in paths]
    assert len(set(stems)) == len(paths) and stems[0] == "a.b"
    assert all(len(f"{folder}/{one}.names".encode()) <= 107 for one in stems)
    with pytest.raises(DriverError, match="shorter place"):
        stem("a/" + "b" * 50, Path("/" + "x" * 100))


def test_a_descriptor_that_is_waited_for_neither_way_does_not_wake_the_loop_when_its_other_end_closes() -> None:
    poller = Poller()
    ours, theirs = socket.socketpair()
    with contextlib.closing(poller), ours, theirs:
        poller.add(ours.fileno())
        poller.add(ours.fileno(), reading=False, writing=False)
        theirs.close()
        assert poller.wait(0) == []
        poller.add(ours.fileno(), writing=True)
        assert poller.wait(0) == [ours.fileno()]


def test_sockets_are_their_users_alone_whatever_the_umask_is(here: Here) -> None:
    before = os.umask(0)
    try:
        with serving(Engine, here):
            modes = {one.suffix: one.stat().st_mode & 0o777 for one in here.directory.iterdir() if one.is_socket()}
    finally:
        os.umask(before)
    assert {".calls", ".hand"} <= modes.keys() and set(modes.values()) == {0o600}, modes


def test_a_directory_of_others_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = folder / "open"
    place.mkdir()
    place.chmod(0o777)
    monkeypatch.setenv(here_module.DIRECTORY, str(place))
    with pytest.raises(DriverError, match="others may write"):
        here_module.here()
    (folder / "link").symlink_to(folder)
    monkeypatch.setenv(here_module.DIRECTORY, str(folder / "link"))
    with pytest.raises(DriverError, match="no directory of this user"):
        here_module.here()


# --- Whole processes -------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def process() -> Iterator[subprocess.Popen[str]]:
    """The example's engine, once it takes messages."""
    command = [sys.executable, ROOT / "examples" / "engine.py"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as one:
        try:
            assert one.stderr is not None
            assert "takes messages at local://" in one.stderr.readline()
            assert "only programs of this user on robot1 reach it" in one.stderr.readline()
            yield one
        finally:
            one.kill()


def test_a_call_survives_the_death_of_the_driver_between_two(here: Here) -> None:
    with process() as first, called(here, "engine") as proxy:
        proxy.call("set", duty=0.5)
        first.kill()
        first.wait()
        path = proxy.path
        assert not lives(here, path)
        with pytest.raises(NoAnswerError, match="its process has ended"):
            proxy.call("read", timeout=0.2)
        with process():
            assert proxy.call("read", timeout=LIMIT_S) == {"duty": 0.0, "rpm": 0.0, "moves": 0}
            assert whole_tree(here).resolve("engine").reach is Reach.LIVE


def test_sigterm_ends_a_driver_after_the_message_in_hand(here: Here) -> None:
    with process() as one:
        one.send_signal(signal.SIGTERM)
        assert one.wait(LIMIT_S) == 0
        assert sorted(path.suffix for path in here.directory.iterdir()) == [".done", ".lock"]


def test_import_of_failover_loads_no_socket(here: Here) -> None:
    script = "import sys, failover\nfailover.driver, failover.command\nprint('zmq' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout == "False\n"


def test_what_cannot_be_a_driver_is_refused_when_it_is_declared() -> None:
    def declared(path: str = "a/b", **arguments: Any) -> None:
        class Odd:
            @failover.query
            def read(self) -> int:
                return 1

        failover.driver(path, **arguments)(Odd)

    for arguments, words in (
        ({"path": "a//b"}, "a step is empty"),
        ({"alias": "a/b"}, "leave out '/'"),
        ({"rate_hz": 0}, "no rate"),
    ):
        with pytest.raises(DriverError, match=words):
            declared(**arguments)
    with pytest.raises(DriverError, match="has no verb"):
        failover.driver("a/b")(type("Empty", (), {}))

    with pytest.raises(DriverError, match="cannot be in a message"):

        @failover.driver("a/b")
        class Spread:
            @failover.query
            def read(self, *names: str) -> None: ...
