"""The board and the drivers for programs of zenoh. The only ``zenoh`` import.

Below a prefix, which is the team's name:

    PREFIX/ROBOT/ITEM           each put, as JSON (`failover.core.board.recording.Put`); a get is answered with the newest
    PREFIX/ROBOT                a liveliness token, while the board says that the robot runs
    PREFIX/@call/DRIVER/VERB    a get calls the driver (its path or its alias) with the fields of its JSON payload

A chunk that begins with ``@`` is matched by no wildcard, so a get of ``PREFIX/**`` calls nothing. zenoh's threads only note what
was asked. The thread of `Stream.run` answers gets; a few threads of the bridge's own call drivers. A program can put nothing.

Source: zenoh 1.x, Key Expressions, Queryables, Liveliness.
"""

from __future__ import annotations

import contextlib
import queue
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec import Struct

from checkpoint.errors import UNDECODABLE
from failover.core.board import layout, recording
from failover.core.board.recording import Schema
from failover.errors import BridgeError, FailoverError, RecordingError

if TYPE_CHECKING:
    from failover.drivers.proxy import Proxy
    from failover.recording.follower import Follower

CALL: Final = "@call"
RUNS: Final = layout.STATES[layout.RUN]
JSON: Final = "application/json"

GETS_MAX: Final = 1024
"""Gets that wait for the next look at the board; of more, those that have waited longest are refused."""
CALLS_MAX: Final = 64
"""Calls that wait for a thread; one more is refused."""
CALLERS: Final = 8
"""Threads that call: one call of a driver goes on at a time, others need not wait for it."""
PROXIES_MAX: Final = 64
"""Drivers whose connections are kept."""
CONNECT_PATIENCE_MS: Final = 5_000

_decode: Final = msgspec.json.Decoder(dict[str, Any]).decode

OpenProxy = Callable[[str], "Proxy"]


class Ends(Struct, frozen=True):
    """Where a bridge meets programs of zenoh.

    Attributes:
        connect, listen: zenoh's endpoints, ``tcp/127.0.0.1:7447``.
        config: a file in zenoh's own form, which may say more: TLS, users, scouting. "": none.
    """

    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    config: str = ""


class ZenohBridge:
    """A session, which is a `failover.recording.stream.Sink`; a context manager.

    Attributes:
        endpoints: at which it listens, or to which it has connected.
    """

    def __init__(self, prefix: str, ends: Ends, follower: Follower, open_proxy: OpenProxy | None) -> None:
        """Open the session.

        Args:
            open_proxy: opens a driver by its name; None: no calls are taken.

        Raises:
            BridgeError: the library is missing, the prefix cannot be one, or no session comes about.
        """
        try:
            import zenoh
        except ImportError:
            raise BridgeError(
                "a bridge to zenoh needs the library eclipse-zenoh, which is not installed: pip install 'failover[zenoh]'"
            ) from None
        self._zenoh: Any = zenoh
        self._prefix = self._checked(prefix)
        self._follower = follower
        self._topics: dict[int, str] = {}
        self._items: dict[str, tuple[str, str]] = {}
        self._said: dict[str, int] = {}
        self._gets: deque[Any] = deque()
        self._waiting: dict[str, list[Any]] = {}
        self._tokens: dict[str, Any] = {}
        self._publishers: dict[str, Any] = {}
        self._session = self._opened(ends)
        self._callers = None if open_proxy is None else _Callers(open_proxy)
        self._queryables = [self._session.declare_queryable(f"{prefix}/*/*", self._gets_item)]
        if self._callers is not None:
            self._queryables.append(self._session.declare_queryable(f"{prefix}/{CALL}/**", self._calls))

    def _checked(self, prefix: str) -> str:
        try:
            key = self._zenoh.KeyExpr(prefix)
        except self._zenoh.ZError as error:
            raise BridgeError(f"{prefix[:60]!r} cannot begin zenoh's keys: {error}; give another --prefix") from None
        if any(sign in prefix for sign in "*$"):
            raise BridgeError(f"{prefix[:60]!r} cannot begin zenoh's keys: it stands for several; give another --prefix")
        return str(key)

    def _opened(self, ends: Ends) -> Any:
        zenoh = self._zenoh
        try:
            config = zenoh.Config.from_file(ends.config) if ends.config else zenoh.Config()
            if not ends.config:
                config.insert_json5("scouting/multicast/enabled", "false")
                config.insert_json5("scouting/gossip/enabled", "false")
                config.insert_json5("mode", '"client"' if ends.connect else '"peer"')
            if ends.connect or ends.listen:
                for what, endpoints in (("connect", ends.connect), ("listen", ends.listen)):
                    config.insert_json5(f"{what}/endpoints", msgspec.json.encode(endpoints).decode())
            if ends.connect:
                config.insert_json5("connect/timeout_ms", str(CONNECT_PATIENCE_MS))
            return zenoh.open(config)
        except (zenoh.ZError, OSError) as error:
            told = " ".join(str(error).split())
            where = ", ".join((*ends.connect, *ends.listen)) or ends.config
            raise BridgeError(f"no zenoh session at {where}: {told[:300]}; give another endpoint, or start the router") from None

    def __enter__(self) -> ZenohBridge:
        return self

    def __exit__(self, *_: object) -> None:
        if self._callers is not None:
            self._callers.close()
        self._session.close()

    # --- As a sink ---

    def channel(self, topic: str, _schema: Schema | None, metadata: Mapping[str, str]) -> int:
        """Puts of an item, or messages on the robots, follow."""
        if "item" in metadata:
            self._items[topic] = (metadata["robot"], metadata["item"])
            if topic not in self._publishers:
                self._publishers[topic] = self._session.declare_publisher(self._prefix + topic, encoding=JSON)
        number = len(self._topics)
        self._topics[number] = topic
        return number

    def add(self, channel: int, _log_ns: int, _publish_ns: int, sequence: int, content: bytes) -> None:
        """Answer those that asked for the item; publish a put that is new."""
        topic = self._topics[channel]
        if topic == recording.ROBOTS_TOPIC:
            self._note_robots(content)
        if topic not in self._items:
            return
        for query in self._waiting.pop(topic, ()):
            self._reply(query, self._prefix + topic, content)
        if self._said.get(topic) != sequence:
            self._said[topic] = sequence
            with contextlib.suppress(self._zenoh.ZError):  # no route: a subscriber that comes back asks for the newest
                self._publishers[topic].put(content)

    def _note_robots(self, content: bytes) -> None:
        with contextlib.suppress(RecordingError):
            running = {one.name for one in recording.read_robots(content).robots if one.state == RUNS}
            for name in self._tokens.keys() - running:
                self._tokens.pop(name).undeclare()
            for name in running - self._tokens.keys():
                self._tokens[name] = self._session.liveliness().declare_token(f"{self._prefix}/{name}")

    # --- Gets ---

    def _gets_item(self, query: Any) -> None:
        """In a thread of zenoh's."""
        self._gets.append(query)
        if len(self._gets) > GETS_MAX:
            with contextlib.suppress(IndexError):
                _refuse(self._gets.popleft(), "too many gets wait for this bridge; ask more seldom")

    def fulfil(self) -> None:
        """Have the next look give the newest values of what was asked for. What the look before gave nothing for has none."""
        for query in [query for queries in self._waiting.values() for query in queries]:
            query.drop()
        self._waiting.clear()
        asked: dict[str, list[Any]] = {}
        while self._gets:
            query = self._gets.popleft()
            there = [topic for topic in self._items if query.key_expr.intersects(self._zenoh.KeyExpr(self._prefix + topic))]
            if not there:
                query.drop()
            for topic in there:
                asked.setdefault(topic, []).append(query)
        for topic in asked:
            self._follower.again(*self._items[topic])
        self._waiting = asked

    def _reply(self, query: Any, key: str, content: bytes) -> None:
        with contextlib.suppress(self._zenoh.ZError):  # it has stopped to wait
            query.reply(key, content, encoding=JSON)

    # --- Calls ---

    def _calls(self, query: Any) -> None:
        """In a thread of zenoh's."""
        if self._callers is not None:
            self._callers.take(query, str(query.key_expr).removeprefix(f"{self._prefix}/{CALL}/"))


class _Callers:
    """Threads that call drivers with the rights of the user who started the bridge."""

    def __init__(self, open_proxy: OpenProxy) -> None:
        self._open = open_proxy
        self._lock = threading.Lock()
        self._proxies: OrderedDict[str, Proxy] = OrderedDict()
        self._waiting: queue.Queue[tuple[Any, str] | None] = queue.Queue(CALLS_MAX)
        self._threads = [threading.Thread(target=self._run, name=f"calls {number}", daemon=True) for number in range(CALLERS)]
        for thread in self._threads:
            thread.start()

    def take(self, query: Any, name: str) -> None:
        try:
            self._waiting.put_nowait((query, name))
        except queue.Full:
            _refuse(query, f"{CALLS_MAX} calls wait for this bridge; call more seldom")

    def close(self) -> None:
        with self._lock:
            proxies, self._proxies = self._proxies, OrderedDict()
        for proxy in proxies.values():
            proxy.close()

    def _run(self) -> None:
        while (taken := self._waiting.get()) is not None:
            query, key = taken
            driver, _, verb = key.rpartition("/")
            try:
                answer = self._called(driver, verb, query)
            except FailoverError as error:
                _refuse(query, str(error))
                continue
            query.reply(query.key_expr, answer, encoding=JSON)
            query.drop()

    def _called(self, driver: str, verb: str, query: Any) -> bytes:
        if not driver or not verb:
            raise BridgeError(f"a call is a get of PREFIX/{CALL}/DRIVER/VERB, with the fields as JSON")
        if any(sign in f"{driver}{verb}" for sign in "*$"):
            raise BridgeError("a call is for one driver and one verb; wildcards name several")
        said = b"" if query.payload is None else bytes(query.payload)
        try:
            fields = _decode(said) if said else {}
        except UNDECODABLE as error:
            raise BridgeError(f"the payload of a call of {driver} is no JSON object: {error}") from None
        return msgspec.json.encode(self._proxy(driver).call(verb, fields or None))

    def _proxy(self, driver: str) -> Proxy:
        with self._lock:
            found = self._proxies.get(driver)
            if found is not None:
                self._proxies.move_to_end(driver)
                return found
        opened = self._open(driver)
        with self._lock:
            kept = self._proxies.setdefault(driver, opened)
            spare = [opened] if kept is not opened else []
            if len(self._proxies) > PROXIES_MAX:
                spare.append(self._proxies.popitem(last=False)[1])
        for proxy in spare:
            proxy.close()
        return kept


def _refuse(query: Any, why: str) -> None:
    with contextlib.suppress(Exception):  # the one who asked has gone: any error of the library says that
        query.reply_err(msgspec.json.encode({"error": why}), encoding=JSON)
    query.drop()
