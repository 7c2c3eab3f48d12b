"""Torn reads: a writer that is killed again and again, readers that look at every byte, and the same with a broken protocol.

    python -m tests.failover.boards.torn --operations 10000000 --kills 1000
    python -m tests.failover.boards.torn --broken        # the zeroing of the bank's number taken out: must find torn reads

Every value says the number of its put in each of its words. So a read is *torn* when two words differ, and *mixed* when they
differ from the number of the reading; a number that is below an earlier one *goes back*.
"""

from __future__ import annotations

import argparse
import inspect
import mmap
import os
import random
import signal
import sys
import tempfile
import textwrap
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FunctionType
from typing import Any

from msgspec import Struct

import failover
from failover.boards import item as board_item
from failover.core.board import banks
from failover.core.board.items import Item
from failover.errors import NeverWrittenError, OvertakenError

READERS = 2
PUTS, FIRST_READER = 0, 1
GETS, TORN, MIXED, BACK, OVERTAKEN = range(5)
LIFE_PUTS_MAX = 4000
"""Puts of one writer before it may be killed, at random."""


class Result(Struct):
    """What was seen."""

    puts: int
    gets: int
    torn: int
    mixed: int
    back: int
    overtaken: int
    kills: int
    users_after: int

    @property
    def wrong(self) -> int:
        """Reads that should never be; of a broken writer only torn ones tell."""
        return self.torn + self.mixed + self.back


def without_zeroing() -> Callable[..., banks.Writer]:
    """The writer of `banks` as it would be without the first step of a put."""
    source = textwrap.dedent(inspect.getsource(banks.writer))
    line = "words[word] = 0\n"
    assert source.count(line) == 1
    namespace: dict[str, Any] = dict(vars(banks))
    exec(compile(source.replace(line, "pass\n"), "<banks.writer without zeroing>", "exec"), namespace)
    made: FunctionType = namespace["writer"]
    return made


class Counters:
    """Numbers that all processes see: puts, and five for each reader."""

    def __init__(self) -> None:
        self.words = memoryview(mmap.mmap(-1, 4096)).cast("Q")

    def of_reader(self, reader: int, what: int) -> int:
        """Index of one of a reader's counters."""
        return FIRST_READER + reader * 8 + what

    def total(self, what: int) -> int:
        """Of all readers."""
        return sum(self.words[self.of_reader(reader, what)] for reader in range(READERS))


def write(counters: Counters, size: int, broken: bool) -> None:
    """Put for ever. A broken writer only shows torn reads: its values are made beforehand, so that it does nothing but put."""
    with failover.board(name="writer") as board:
        item = board.item("value", bytes)
        try:
            number = item.get().number
        except NeverWrittenError:
            number = 0
        words = size // 8
        made = [bytes([place]) * size for place in range(7)]  # no multiple of the banks
        while True:
            number += 1
            item.put(made[number % 7] if broken else number.to_bytes(8, "little") * words)
            counters.words[PUTS] = counters.words[PUTS] + 1


def read(counters: Counters, reader: int, size: int) -> None:
    """Get for ever, and look at each byte."""
    with failover.board(name="reader") as board:
        item = board.item("value", bytes)
        words, at = size // 8, counters.of_reader(reader, 0)
        count, newest = counters.words, 0
        while True:
            try:
                found = item.get()
            except NeverWrittenError:
                continue
            except OvertakenError:
                count[at + OVERTAKEN] += 1
                continue
            first = found.value[:8]
            if found.value != first * words:
                count[at + TORN] += 1
            elif int.from_bytes(first, "little") != found.number:
                count[at + MIXED] += 1
            if found.number < newest:
                count[at + BACK] += 1
            newest = found.number
            count[at + GETS] += 1


@contextmanager
def child(work: Callable[[], None]) -> Iterator[int]:
    """A forked process that works until it is killed."""
    pid = os.fork()
    if pid == 0:
        try:
            work()
        finally:
            traceback.print_exc()
            os._exit(1)
    try:
        yield pid
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)


def run(operations: int, kills: int, size: int, seed: int, *, broken: bool = False, until_wrong: bool = False) -> Result:
    """So many puts and gets together, and so many killed writers; or until something is wrong.

    The environment says where the board is; it is made, and gone afterwards.
    """
    dice = random.Random(seed)
    counters = Counters()
    right = board_item.writer_of
    if broken:
        board_item.writer_of = without_zeroing()  # type: ignore[assignment]
    try:
        with failover.board(name="torn") as board:
            board.add(Item("value", size=size, shared=False))
            done = 0
            readers = [child(lambda reader=reader: read(counters, reader, size)) for reader in range(READERS)]  # type: ignore[misc]
            for reader in readers:
                reader.__enter__()
            try:
                while done < kills or counters.words[PUTS] + counters.total(GETS) < operations:
                    begun, life = counters.words[PUTS], dice.randrange(1, LIFE_PUTS_MAX)
                    with child(lambda: write(counters, size, broken)) as writer:
                        while counters.words[PUTS] - begun < life:
                            assert os.waitpid(writer, os.WNOHANG) == (0, 0), "the writer ended by itself"
                            time.sleep(dice.random() * 0.001)
                    done += 1
                    if until_wrong and counters.total(TORN):
                        break
                users = len(board.users())
            finally:
                for reader in readers:
                    reader.__exit__(None, None, None)
            assert len(board.users()) == 1, board.users()
    finally:
        board_item.writer_of = right
    totals = [counters.total(what) for what in range(5)]
    return Result(counters.words[PUTS], *totals, done, users)


def main() -> int:
    """Exit status 0: as it should be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--operations", type=int, default=1_000_000)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--seed", type=int, default=random.randrange(1 << 32))
    parser.add_argument("--broken", action="store_true")
    arguments = parser.parse_args()
    print(f"seed {arguments.seed}", flush=True)
    with tempfile.TemporaryDirectory(prefix="failover-torn-", dir="/dev/shm") as folder:
        os.environ["FAILOVER_BOARD"] = f"{folder}/board"
        started = time.monotonic()
        result = run(arguments.operations, arguments.kills, arguments.size, arguments.seed, broken=arguments.broken)
        left = list(Path(folder).rglob("*"))
    print(f"{result} in {time.monotonic() - started:.0f} s; left in /dev/shm: {left}")
    is_right = (result.torn > 0 if arguments.broken else result.wrong == 0) and not left
    print("as it should be" if is_right else "WRONG")
    return 0 if is_right else 1


if __name__ == "__main__":
    sys.exit(main())
