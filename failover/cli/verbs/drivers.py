"""names, call, send, path, graph: who answers to which name, and messages to drivers by hand."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import time
from collections import defaultdict
from typing import Any, Final, cast

import msgspec

from failover.cli.output import graph as graph_output
from failover.cli.output import names_tree, render
from failover.core.messaging import envelope as envelopes
from failover.core.messaging.clocks import Bounds, ClockPair, Part, further_ways, parts
from failover.core.messaging.envelope import MESSAGE_SIZE_MAX, Envelope, Hop
from failover.core.messaging.traffic import Edge
from failover.core.naming.tree import Place, Reach, Tree, robot_of
from failover.drivers.here import Here, here
from failover.drivers.lookup import lookup, whole_tree
from failover.drivers.proxy import Proxy
from failover.drivers.route import address_of, way_to
from failover.errors import CallRefusedError, DriverError, EnvelopeError, NameUnknownError, NoAnswerError, RequestError

EXCHANGES: Final = 8
"""Messages to and fro from which the offset of a robot's clock is found: the fastest of each direction count."""

ASK_S: Final = 2.0
"""How long each driver is asked whether it remembers a message."""


def names(arguments: argparse.Namespace) -> int:
    """The tree of names. Exit status 1: a name is unreachable, claimed twice, or refused."""
    tree = whole_tree(here())
    found = [_told(place) for place in tree.under(arguments.prefix)]
    if arguments.prefix and not found:
        raise NameUnknownError(f"no driver is registered under {arguments.prefix}")
    if arguments.json:
        render.as_json({"names": found})
    else:
        render.painted(names_tree.COLUMNS, names_tree.rows(found), f"{len(found)} names")
    return 1 if any(one["reach"] != Reach.LIVE or one["rivals"] or one["refused"] for one in found) else 0


def _told(place: Place) -> dict[str, Any]:
    """A place as JSON."""
    record: dict[str, Any] = {"kind": place.record.kind} | msgspec.to_builtins(place.record)
    lists = {key: record.get(key, []) for key in ("aliases", "addresses", "versions")}
    stands = {"robot": place.robot, "origin": place.origin, "reach": str(place.reach), "rivals": list(place.rivals)}
    return record | lists | {"verbs": record.get("verbs", {})} | stands | {"refused": place.refused}


def call(arguments: argparse.Namespace) -> int:
    """Have a verb carried out, and print what it returns as JSON."""
    body = _json(arguments.body, "body") if arguments.body is not None else None
    place = here()
    with Proxy(place, lookup(place, arguments.name)) as driver:
        value = driver.call(arguments.call_verb, body, timeout=arguments.timeout_s)
        if arguments.json:
            render.as_json({"ok": value, "id": driver.last.re if driver.last is not None else "", "path": driver.path})
        else:
            print(render.spoken(render.json_text(value)), flush=True)
    return 0


def send(arguments: argparse.Namespace) -> int:
    """Send a message as it was written, and print the answer as it came. Exit status 1: the answer is an error."""
    text = sys.stdin.read(MESSAGE_SIZE_MAX + 1) if arguments.message == "-" else arguments.message
    written = _json(text, "message")
    if not isinstance(written, dict):
        raise RequestError('a message is a JSON object, as in {"verb": "read"}')
    fields = {"to": arguments.name} | written
    content = json.dumps(fields, ensure_ascii=False).encode()
    envelopes.decode(content)
    place = here()
    found = lookup(place, arguments.name)
    answer = _exchanged(place, found, content, arguments.timeout_s)
    print(render.spoken(answer.decode(errors="replace")), flush=True)
    return 1 if envelopes.decode(answer).error is not msgspec.UNSET else 0


def _exchanged(here: Here, place: Place, content: bytes, timeout_s: float) -> bytes:
    """The answer to one message.

    Raises:
        NoAnswerError: there is none.
    """
    timeout_ns = round(timeout_s * 1e9)
    way = way_to(here, address_of(here, place), place.robot)
    try:
        if way.await_sent(content, timeout_ns) and (answer := way.await_message(timeout_ns)) is not None:
            return answer
    finally:
        way.close()
    raise NoAnswerError(f"{place.record.path} did not answer within {timeout_s:g} s; it may still carry the message out")


def _json(text: str, what: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise RequestError(f"the {what} is not JSON: {error}; text stands in double quotes, as in '\"blue\"'") from error


# --- What drivers tell of messages --------------------------------------------------------------------------------------------


def graph(arguments: argparse.Namespace) -> int:
    """Who has talked to whom in the last hour; with --watch again and again until Ctrl-C."""
    place = here()
    with render.live_table() if arguments.watch else contextlib.nullcontext(render.painted) as draw:
        while True:
            found = _edges(place, whole_tree(place))
            edges = found.edges
            if arguments.json:
                render.as_json(msgspec.to_builtins(found))
            elif arguments.dot:
                print(render.spoken(graph_output.dot(edges)), flush=True)
            else:
                told = f"; no answer from {', '.join(found.silent)}" if found.silent else ""
                draw(graph_output.COLUMNS, graph_output.rows(edges), f"{len(edges)} edges in the last hour{told}")
            for sentence in found.mistaken:
                print(f"failover: {render.spoken(sentence)}", file=sys.stderr, flush=True)
            if not arguments.watch:
                return 1 if found.silent or found.mistaken else 0
            time.sleep(arguments.every_ms / 1_000)
    return 0  # Ctrl-C ended the watch


Hops = tuple[Hop, ...] | None


class _Graph(msgspec.Struct):
    """What all drivers told.

    Attributes:
        edges: the busiest first.
        silent: drivers that did not tell theirs. mistaken: a sentence for each whose answer cannot be read.
    """

    edges: list[dict[str, Any]]
    silent: list[str]
    mistaken: list[str]


def _edges(here: Here, tree: Tree) -> _Graph:
    found = _Graph([], [], [])
    for place in _live(tree):
        try:
            driver = Proxy(here, place)
        except DriverError:
            found.silent.append(place.record.path)
            continue
        with driver:
            try:
                edges = driver.told("_graph", list[Edge], timeout=ASK_S)
            except (NoAnswerError, CallRefusedError):
                found.silent.append(driver.path)
            except DriverError as error:
                found.mistaken.append(str(error))
            else:
                found.edges += [{"from": one.sender, "to": driver.path} | msgspec.to_builtins(one) for one in edges]
    found.edges.sort(key=lambda row: (-row["count"], row["from"], row["to"], row["verb"]))
    return found


def path(arguments: argparse.Namespace) -> int:
    """Where a message spent its time, hop by hop."""
    place = here()
    tree = whole_tree(place)
    hops = _remembered(place, tree, arguments.id)
    clocks = _Clocks(place, tree)

    def told(way: tuple[Hop, ...]) -> list[dict[str, Any]]:
        return [_part(one) for one in parts(way, clocks.offset)]

    found, further = told(hops), [told(way) for way in further_ways(hops, _began_with(place, tree, hops[0]))]
    if arguments.json:
        render.as_json({"id": arguments.id, "parts": found, "further": further})
        return 0
    render.painted(names_tree.PATH_COLUMNS, names_tree.path_rows(found), f"message {arguments.id}")
    for way in further:
        render.painted(names_tree.PATH_COLUMNS, names_tree.path_rows(way), f"and further to {way[-1]['who']}")
    return 0


def _remembered(here: Here, tree: Tree, wanted: str) -> tuple[Hop, ...]:
    """The hops of a message, from the driver that remembers it.

    Raises:
        NameUnknownError: none does.
    """
    asked = 0
    for place in _live(tree):
        try:
            with Proxy(here, place) as driver:
                hops = driver.told("_path", cast("type[tuple[Hop, ...] | None]", Hops), {"id": wanted}, timeout=ASK_S)
            envelopes.check_hops(hops or ())
        except (NoAnswerError, CallRefusedError, DriverError, EnvelopeError):
            continue
        asked += 1
        if hops:
            return hops
    raise NameUnknownError(
        f"none of the {asked} drivers that answered remembers a message {wanted!r}: each keeps its last 4096; "
        "failover call --json prints the id of a message"
    )


def _began_with(here: Here, tree: Tree, first: Hop) -> list[tuple[Hop, ...]]:
    """The ways that drivers remember of messages that began with this hop."""
    found: list[tuple[Hop, ...]] = []
    for place in _live(tree):
        try:
            with Proxy(here, place) as driver:
                ways = driver.told("_ways", list[tuple[Hop, ...]], {"began": [first.who, first.came]}, timeout=ASK_S)
            for way in ways:
                envelopes.check_hops(way)
        except (NoAnswerError, CallRefusedError, DriverError, EnvelopeError):  # also a driver of an older failover
            continue
        found += ways
    return found


def _live(tree: Tree) -> list[Place]:
    return [place for place in tree.under() if place.record.kind == "driver" and place.reach is Reach.LIVE and not place.refused]


class _Clocks:
    """Offsets of the robots' clocks from this one's, each found by some messages when it is first asked for.

    All processes of a robot share one clock, so between them it is 0.
    """

    def __init__(self, here: Here, tree: Tree) -> None:
        self._here = here
        self._tree = tree
        self._pairs: defaultdict[str, ClockPair] = defaultdict(ClockPair)
        self._asked: set[str] = set()

    def offset(self, who: str, other: str, at_ns: int) -> Bounds:
        """Clock of ``other`` minus clock of ``who``, at an instant of the latter."""
        one, two = robot_of(who), robot_of(other)
        if one == two:
            return Bounds(0, 0)
        at_ns -= self._from_here(one, at_ns).middle_ns or 0  # the pairs count by our clock
        first, second = self._from_here(one, at_ns), self._from_here(two, at_ns)
        return Bounds(_less(second.low_ns, first.high_ns), _less(second.high_ns, first.low_ns))

    def _from_here(self, robot: str, at_ns: int) -> Bounds:
        if robot == self._here.robot:
            return Bounds(0, 0)
        if robot not in self._asked:
            self._asked.add(robot)
            self._ask(robot)
        return self._pairs[robot].offset(at_ns)

    def _ask(self, robot: str) -> None:
        place = next((one for one in _live(self._tree) if one.robot == robot), None)
        if place is None:
            return
        with Proxy(self._here, place) as driver:
            for _ in range(EXCHANGES):
                try:
                    driver.call("_path", {"id": ""}, timeout=ASK_S)
                except (NoAnswerError, CallRefusedError):
                    return
                self._take(robot, driver.last, driver.now_ns())

    def _take(self, robot: str, answer: Envelope | None, came_ns: int) -> None:
        if answer is None or len(answer.hops) != 2:
            return
        ours, theirs = answer.hops
        if ours.left_ns is not None and theirs.left_ns is not None:
            self._pairs[robot].forward(ours.left_ns, theirs.came_ns)
            self._pairs[robot].backward(theirs.left_ns, came_ns)


def _less(one: int | None, other: int | None) -> int | None:
    return None if one is None or other is None else one - other


def _part(one: Part) -> dict[str, Any]:
    middle = one.took.middle_ns
    bounds = {"took_ms": middle, "at_least_ms": one.took.low_ns, "at_most_ms": one.took.high_ns}
    return {"who": one.who, "to": one.to} | {key: None if ns is None else round(ns / 1e6, 4) for key, ns in bounds.items()}
