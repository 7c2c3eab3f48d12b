"""simulate: which world, for how long, how fast."""

from __future__ import annotations

import argparse
import math

from failover.cli.arguments.shared import add_json, add_place_of_board, positive
from failover.config import quantities

SEED_MAX = (1 << 63) - 1


def simulate(room: argparse.ArgumentParser) -> None:
    """Of ``failover simulate``."""
    room.add_argument("--robots", metavar="N", type=positive, help="so many robots like Robotino (default: 1)")
    room.add_argument("--labs", metavar="N", type=positive, help="in so many labs (default: 1)")
    room.add_argument("--world", metavar="FILE", help="a world file, or the name of one that comes with failover: amur-7")
    room.add_argument("--seed", metavar="N", type=_seed, help="of the sensors' noise (default: the file's, or 1)")
    room.add_argument("--for", dest="span_s", metavar="S", type=_span_s, help="seconds, or 10min (default: until Ctrl-C)")
    room.add_argument(
        "--pace",
        metavar="X",
        type=_pace,
        default=1.0,
        help="so many times as fast; max: without real time (default: 1)",
    )
    add_place_of_board(room)
    add_json(room)


def _seed(text: str) -> int:
    if not text.isascii() or not text.isdigit() or int(text[:20]) > SEED_MAX:
        raise argparse.ArgumentTypeError(f"{text[:40]!r} is no seed: write a whole number from 0 on")
    return int(text)


def _span_s(text: str) -> float:
    try:
        return int(text) if text.isdecimal() and int(text[:9]) else quantities.span_ms(text) / 1_000
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _pace(text: str) -> float:
    """How many times as fast; 0 for "max"."""
    if text == "max":
        return 0.0
    try:
        pace = float(text)
    except ValueError:
        pace = math.nan
    if not 0.01 <= pace <= 100:
        raise argparse.ArgumentTypeError(f"{text[:40]!r} is no pace: write a number from 0.01 to 100, or max")
    return pace
