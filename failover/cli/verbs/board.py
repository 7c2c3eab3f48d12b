"""board, board get, put, top, users: the items on the board of this robot, and a put by hand."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from checkpoint.sentences import near
from failover.boards import directory
from failover.boards.board import Board, board
from failover.boards.overview import Seen, overview
from failover.cli.output import board_tree, render
from failover.cli.output.board_tree import ms
from failover.core.board.item_types import parse
from failover.core.board.json_values import of_json, plain
from failover.errors import BoardError, BoardGoneError, RequestError

NAME: Final = "failover board"
"""Of this program among the board's users."""

VALUE_TEXT_MAX: Final = 1 << 20
"""Bytes of a value's JSON: the largest item, each byte in words, is shorter."""

SAMPLE_S: Final = 0.05
"""Between two looks of ``top``."""


@contextlib.contextmanager
def board_there(arguments: argparse.Namespace) -> Iterator[Board]:
    """The board of this robot, if there is one: looking at it must not make it.

    Raises:
        BoardError: there is none.
    """
    place = Path(arguments.board) if arguments.board else directory.find()
    if not (place / directory.OWN_NAME).exists():
        raise BoardError(
            f"there is no board in {place}: no agent runs here with one, and no program of this user has made it; "
            "a program makes it with failover.board(), team.toml declares it for the agent"
        )
    with board(place, NAME) as opened:
        yield opened


def show(arguments: argparse.Namespace) -> int:
    """The tree; with --watch again and again until Ctrl-C. Exit status 1: an item is stale or cannot be read."""
    with board_there(arguments) as opened:
        before, since = overview(opened), time.monotonic()
        with render.live_table() if arguments.watch else contextlib.nullcontext(render.painted) as draw:
            while True:
                time.sleep(arguments.every_ms / 1000)
                now = time.monotonic()
                seen = overview(opened)
                answer = _answer(opened, seen, _rates(before, seen, now - since))
                if arguments.json:
                    render.as_json(answer)
                else:
                    draw(board_tree.COLUMNS, board_tree.rows(answer, _json), f"board of {opened.robot}")
                if not arguments.watch:
                    return 1 if any(one.stale or one.complaint for one in seen) else 0
                before, since = seen, now
    return 0  # Ctrl-C ended the watch


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


def _rates(before: list[Seen], after: list[Seen], passed_s: float) -> dict[tuple[str, str], float]:
    """(robot, item) → puts a second, of those that were there before."""
    numbers = {(one.robot, one.item): one.put for one in before}
    found = {}
    for one in after:
        key = (one.robot, one.item)
        if key in numbers and passed_s > 0:
            found[key] = round(max(one.put - numbers[key], 0) / passed_s, 2)
    return found


def _answer(opened: Board, seen: list[Seen], rates: dict[tuple[str, str], float]) -> dict[str, Any]:
    """The answer that ``--json`` prints."""
    guests = opened.guests()
    robots = {
        name: {"state": robot.state, "age_ms": ms(robot.age_ns), "rank": robot.rank}
        | ({"simulated": True} if name in guests else {})
        for name, robot in (opened.robots() | guests).items()
    }
    return {
        "robot": opened.robot,
        "directory": str(opened.directory),
        "robots": robots,
        "items": [_told(one) | {"rate_per_s": rates.get((one.robot, one.item))} for one in seen],
    }


def _told(one: Seen) -> dict[str, Any]:
    """An item as JSON."""
    words = {name: getattr(one, name) for name in one.__struct_fields__ if not name.endswith("_ns")}
    spans = {"age_ms": ms(one.age_ns), "age_max_ms": ms(one.age_max_ns), "bound_ms": ms(one.bound_ns)}
    return words | {"value": plain(one.value)} | spans


# --- One item --------------------------------------------------------------------------------------------------------


def _split(path: str, opened: Board) -> tuple[str, str]:
    """Robot and item of ``ROBOT/ITEM``; an item alone is this robot's.

    Raises:
        BoardError: there is no such robot; names the nearest.
    """
    robot, _, item = path.rpartition("/")
    robots = [*opened.robots(), *opened.guests()]
    if robot and robot not in robots:
        raise BoardError(f"there is no robot {robot!r} on this board{near(robot, robots)}; it has {', '.join(robots)}")
    return robot or opened.robot, item


def _found(opened: Board, path: str) -> Seen:
    robot, item = _split(path, opened)
    of_robot = [one for one in overview(opened) if one.robot == robot]
    for one in of_robot:
        if one.item == item:
            return one
    names = [one.item for one in of_robot]
    listed = near(item, names) or (f"; it has {', '.join(sorted(names)[:8])}" if names else "; it has none")
    raise BoardError(f"{robot} has no item {item!r}{listed}")


def get(arguments: argparse.Namespace) -> int:
    """Print one item's value, how old it is and can be; with --watch each new one. Exit status 1: it is stale."""
    with board_there(arguments) as opened:
        one = _found(opened, arguments.path)
        handle = opened.item(one.item)
        after = None
        while True:
            try:
                reading = handle.get(one.robot) if after is None else handle.wait(one.robot, after=after, timeout=1.0)
            except TimeoutError:
                continue
            seen = _found(opened, f"{one.robot}/{one.item}")
            told = {
                "robot": reading.robot,
                "item": one.item,
                "value": plain(reading.value),
                "age_ms": ms(reading.age_ns),
                "age_max_ms": ms(reading.age_max_ns) if seen.age_max_ns is not None else None,
                "bound_ms": ms(seen.bound_ns),
                "stale": reading.stale,
                "put": reading.number,
            }
            if arguments.json:
                render.as_json(told)
            else:
                print(render.spoken(_sentence(told)), flush=True)
            if not arguments.watch:
                return 1 if reading.stale else 0
            after = reading.number


def _sentence(told: dict[str, Any]) -> str:
    most = "no upper bound known" if told["age_max_ms"] is None else f"at most {told['age_max_ms']} ms"
    stale = f", stale: its bound is {told['bound_ms']} ms" if told["stale"] else ""
    return f"{_json(told['value'])}  {told['age_ms']} ms old, {most}, put {told['put']}{stale}"


def put(arguments: argparse.Namespace) -> int:
    """Put one value of this robot, from JSON."""
    text = sys.stdin.read(VALUE_TEXT_MAX + 1) if arguments.value == "-" else arguments.value
    if len(text) > VALUE_TEXT_MAX:
        raise RequestError(f"the value has more than {VALUE_TEXT_MAX} bytes; no item is so large")
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise RequestError(f"the value is not JSON: {error}; text stands in quotes, as in '\"blue\"'") from error
    with board_there(arguments) as opened:
        robot, _ = _split(arguments.path, opened)
        if robot != opened.robot:
            raise BoardError(f"{robot} alone writes its items, and this robot is {opened.robot}: give this order at {robot}")
        one = _found(opened, arguments.path)
        opened.item(one.item).put(of_json(parse(one.type), value, one.item))
        number = _found(opened, arguments.path).put
    told = {"robot": robot, "item": one.item, "put": number}
    if arguments.json:
        render.as_json(told)
    else:
        print(f"{robot}/{one.item}: put {number}")
    return 0


# --- Rates and users -------------------------------------------------------------------------------------------------


def top(arguments: argparse.Namespace) -> int:
    """Rates, sizes, ages and losses of every item over a span; with --watch again and again."""
    with (
        board_there(arguments) as opened,
        render.live_table() if arguments.watch else contextlib.nullcontext(render.painted) as draw,
    ):
        while True:
            items = _measured(opened, arguments.every_ms / 1000)
            if arguments.json:
                render.as_json({"robot": opened.robot, "items": items})
            else:
                draw(board_tree.TOP_COLUMNS, board_tree.top_rows(items), f"board of {opened.robot}, over {arguments.every_ms} ms")
            if not arguments.watch:
                break
    return 0


def _measured(opened: Board, span_s: float) -> list[dict[str, Any]]:
    """Every item with its rate, and the ages that were seen, over a span."""
    begin = time.monotonic()
    first = last = overview(opened)
    ages: dict[tuple[str, str], list[int]] = {}
    while (left_s := begin + span_s - time.monotonic()) > 0:
        time.sleep(min(SAMPLE_S, left_s))
        with contextlib.suppress(BoardGoneError):
            last = overview(opened)
        for one in last:
            if one.age_ns is not None:
                ages.setdefault((one.robot, one.item), []).append(one.age_ns)
    rates = _rates(first, last, time.monotonic() - begin)
    found = []
    for one in last:
        key = (one.robot, one.item)
        ordered = sorted(ages.get(key, ()))
        percentiles = {f"age_p{share}_ms": ms(ordered[len(ordered) * share // 100]) if ordered else None for share in (50, 99)}
        told = _told(one)
        del told["value"]
        found.append(told | percentiles | {"rate_per_s": rates.get(key)})
    return found


def users(arguments: argparse.Namespace) -> int:
    """The programs that have the board open, without this one."""
    with board_there(arguments) as opened:
        found = [
            {"pid": pid, "uid": uid, "user": _user(uid), "name": name}
            for pid, uid, name in opened.users()
            if (pid, name) != (os.getpid(), NAME)
        ]
        if arguments.json:
            render.as_json({"robot": opened.robot, "users": found})
            return 0
        print(f"{len(found)} programs use the board of {opened.robot}")
    if found:
        render.table(("pid", "user", "program"), [(str(one["pid"]), str(one["user"]), str(one["name"])) for one in found])
    return 0


def _user(uid: int) -> str:
    from failover.config import accounts  # here: one act of failover board shows users

    return accounts.name_of(uid) or str(uid)
