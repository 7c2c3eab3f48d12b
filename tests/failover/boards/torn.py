"""Torn reads: programs that are killed again and again, readers that look at every byte, and the same with a broken protocol.

    python -m tests.failover.boards.torn --operations 10000000 --kills 1000
    python -m tests.failover.boards.torn --for 600       # kills of writers, readers and programs that change the table
    python -m tests.failover.boards.torn --broken --size 65536 # the zeroing of the bank's number taken out: must find torn reads

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
from collections.abc import Callable
from functools import partial
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
PUTS, CHANGES, FIRST_READER = 0, 1, 2
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
    changes: int
    kills: int

    @property
    def wrong(self) -> int:
        """Reads that should never be; of a broken writer only torn ones tell."""
        return self.torn + self.mixed + self.back


def without_zeroing() -> Callable[..., banks.Writer]:
    """The writer of `banks` as it would be without the first step of a put."""
    source = textwrap.dedent(inspect.getsource(banks.writer))
    line = "words[head] = 0\n"
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

    def looks(self, reader: int) -> int:
        """How often a reader has tried."""
        return self.words[self.of_reader(reader, GETS)] + self.words[self.of_reader(reader, OVERTAKEN)]

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


def change(counters: Counters) -> None:
    """Change the table for ever: an item that is there already is declared again, and the generation moves each time."""
    with failover.board(name="changer") as board:
        while True:
            board.add(Item("extra", size=8, shared=False))
            counters.words[CHANGES] = counters.words[CHANGES] + 1


class Killable:
    """A forked process that works until it is killed; it can be begun again."""

    def __init__(self, work: Callable[[], None], progress: Callable[[], int]) -> None:
        self._work = work
        self._progress = progress
        self._pid = 0

    def begin(self) -> None:
        """It works when this returns."""
        before = self._progress()
        self._pid = os.fork()
        if self._pid == 0:
            try:
                self._work()
            finally:
                traceback.print_exc()
                os._exit(1)
        while self._progress() == before:
            self.check()
            time.sleep(0.0001)

    def check(self) -> None:
        """It has not ended by itself."""
        assert os.waitpid(self._pid, os.WNOHANG) == (0, 0), "a program ended by itself"

    def kill(self) -> None:
        """At whatever instruction it is."""
        if self._pid:
            os.kill(self._pid, signal.SIGKILL)
            os.waitpid(self._pid, 0)
            self._pid = 0


def run(
    operations: int, kills: int, size: int, seed: int, *, seconds: float = 0, broken: bool = False, until_wrong: bool = False
) -> Result:
    """So many puts and gets together, so many killed writers, and so long; or until something is wrong.

    With each fifth writer a reader or the program that changes the table is killed, too. The environment says where the board
    is; it is made, and gone afterwards.
    """
    dice = random.Random(seed)
    counters = Counters()
    right = board_item.writer_of
    if broken:
        board_item.writer_of = without_zeroing()  # type: ignore[assignment]
    writer = Killable(lambda: write(counters, size, broken), lambda: counters.words[PUTS])
    readers = [Killable(partial(read, counters, reader, size), partial(counters.looks, reader)) for reader in range(READERS)]
    changer = Killable(lambda: change(counters), lambda: counters.words[CHANGES])
    end = time.monotonic() + seconds
    try:
        with failover.board(name="torn") as board:
            board.add(Item("value", size=size, shared=False))
            done = 0
            try:
                for one in (writer, *readers, changer):
                    one.begin()
                while done < kills or counters.words[PUTS] + counters.total(GETS) < operations or time.monotonic() < end:
                    begun, life = counters.words[PUTS], dice.randrange(1, LIFE_PUTS_MAX)
                    while counters.words[PUTS] - begun < life:
                        writer.check()
                        time.sleep(dice.random() * 0.001)
                    for one in (writer, *([dice.choice((*readers, changer))] if dice.random() < 0.2 else [])):
                        one.kill()
                        one.begin()
                    done += 1
                    assert len(board.users()) == 3 + READERS, board.users()  # the killed ones are not counted
                    if until_wrong and counters.total(TORN):
                        break
            finally:
                for one in (writer, *readers, changer):
                    one.kill()
            assert len(board.users()) == 1, board.users()
    finally:
        board_item.writer_of = right
    totals = [counters.total(what) for what in range(5)]
    return Result(counters.words[PUTS], *totals, counters.words[CHANGES], done)  # type: ignore[call-arg]


def main() -> int:
    """Exit status 0: as it should be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--operations", type=int, default=1_000_000)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--for", dest="seconds", type=float, default=0, metavar="SECONDS", help="at least so long")
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--seed", type=int, default=random.randrange(1 << 32))
    parser.add_argument("--broken", action="store_true")
    arguments = parser.parse_args()
    print(f"seed {arguments.seed}", flush=True)
    with tempfile.TemporaryDirectory(prefix="failover-torn-", dir="/dev/shm") as folder:
        os.environ["FAILOVER_BOARD"] = f"{folder}/board"
        started = time.monotonic()
        wanted = (arguments.operations, arguments.kills, arguments.size, arguments.seed)
        result = run(*wanted, seconds=arguments.seconds, broken=arguments.broken, until_wrong=arguments.broken)
        left = list(Path(folder).rglob("*"))
    print(f"{result} in {time.monotonic() - started:.0f} s; left in /dev/shm: {left}")
    is_right = (result.torn > 0 if arguments.broken else result.wrong == 0) and not left
    print("as it should be" if is_right else "WRONG")
    return 0 if is_right else 1


if __name__ == "__main__":
    sys.exit(main())
