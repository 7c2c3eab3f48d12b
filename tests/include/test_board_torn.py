"""No get mixes two puts, wherever the writer is killed, and whichever language it is in; files that lie crash no program in C."""

from __future__ import annotations

import os
import random
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

from failover.boards import directory
from failover.boards.board import Board, board
from failover.core.board import layout
from failover.core.board.items import Item
from failover.errors import BoardError, NeverWrittenError, OvertakenError
from tests.include.board_programs import place_for_board
from tests.include.programs import HERE, ROOT, STRICT, folder, program

pytestmark = pytest.mark.compiler

KILLS = int(os.environ.get("FAILOVER_BOARD_KILLS", "60"))
READS = int(os.environ.get("FAILOVER_BOARD_READS", "300000"))
SEED = int(os.environ.get("FAILOVER_SEED", str(random.randrange(1 << 32))))
SMALL, LARGE = 379, 65536
BANKS = {SMALL: 2, LARGE: 8}
"""Of a large value that is put without a pause two are overtaken always."""
PYTHON_WRITER = """
import sys
from failover.boards.board import board
with board() as opened:
    item, size, number = opened.item(sys.argv[1]), int(sys.argv[2]), 0
    while True:
        number += 1
        item.put((number.to_bytes(8, "little") * (size // 8 + 1))[:size])
        if number == 1:
            print("ready", flush=True)
"""


@pytest.fixture
def place() -> Iterator[Path]:
    with place_for_board() as found:
        yield found


@contextmanager
def running(place: Path, *words: object) -> Iterator[subprocess.Popen[str]]:
    """A program with the board, from when it is ready on, for the body."""
    started = subprocess.Popen(
        list(map(str, words)), env={**os.environ, "FAILOVER_BOARD": str(place)}, stdout=subprocess.PIPE, text=True
    )  # fmt: skip
    try:
        assert started.stdout is not None
        assert started.stdout.readline() == "ready\n"
        yield started
    finally:
        started.kill()
        started.communicate()


def counts(reader: subprocess.Popen[str]) -> dict[str, int]:
    """What a reader in C has counted."""
    assert reader.stdout is not None
    told = reader.stdout.readline()
    return {word: int(count) for word, count in re.findall(r"(\w+) (\d+)", told)}


def with_item(python: Board, size: int, banks: int = 2) -> None:
    python.add(Item("value", size=size, shared=size == SMALL, banks=banks))


def read_all(python: Board, until: float, since: int) -> int:
    """Get as often as there is time; the newest number. Fails at a torn value."""
    item, newest = python.item("value"), since
    while time.monotonic() < until:
        try:
            reading = item.get()
        except (NeverWrittenError, OvertakenError):
            continue
        assert reading.value == (reading.value[:8] * (len(reading.value) // 8 + 1))[: len(reading.value)], "torn"
        assert reading.number >= newest
        newest = reading.number
    return newest


@pytest.mark.parametrize("size", [SMALL, LARGE])
def test_a_writer_in_c_that_is_killed_at_any_instant_leaves_whole_values_to_python_and_c(place: Path, size: int) -> None:
    dice = random.Random(SEED)
    print(f"FAILOVER_SEED={SEED}")
    torn = program("board_torn")
    with board(place) as python:
        with_item(python, size, BANKS[size])
        newest = 0
        with running(place, torn, "read", "value", size, READS if size == SMALL else READS // 100) as reader:
            for _ in range(KILLS):
                with running(place, torn, "write", "value", size):
                    newest = read_all(python, time.monotonic() + dice.random() * 0.02, newest)
            found = counts_of_reader_beside(place, reader, torn, size)
        assert found["torn"] == found["backwards"] == 0
        assert found["found"] > 0
        assert newest > 0
        assert python.item("value").get().number >= newest


def counts_of_reader_beside(place: Path, reader: subprocess.Popen[str], torn: Path, size: int) -> dict[str, int]:
    """What a reader counts that reads on beside one more writer until it is done."""
    with running(place, torn, "write", "value", size):
        return counts(reader)


@pytest.mark.parametrize("size", [SMALL, LARGE])
def test_a_writer_in_python_that_is_killed_at_any_instant_leaves_whole_values_to_c(place: Path, size: int) -> None:
    dice = random.Random(SEED)
    print(f"FAILOVER_SEED={SEED}")
    torn = program("board_torn")
    with board(place) as python:
        with_item(python, size, BANKS[size])
        for _ in range(max(KILLS // 20, 2)):
            with running(place, sys.executable, "-c", PYTHON_WRITER, "value", size) as writer:
                with running(place, torn, "read", "value", size, 20_000 if size == SMALL else 2_000) as reader:
                    time.sleep(dice.random() * 0.01)
                    writer.kill()
                    found = counts(reader)
            assert found["torn"] == found["backwards"] == 0
            assert found["found"] > 0


def without_zeroing() -> Path:
    """board_torn.c with a header whose put leaves the number of the bank that it writes as it is."""
    header = (ROOT / "include" / "failover_board.h").read_text()
    zeroing = "    __atomic_store_n((uint64_t *)(void *)bank, 0, __ATOMIC_RELAXED);\n"
    assert header.count(zeroing) == 1
    (folder() / "mutant").mkdir(exist_ok=True)
    (folder() / "mutant" / "failover_board.h").write_text(header.replace(zeroing, ""))
    made = folder() / "board_torn_mutant"
    source = HERE / "board_torn.c"
    subprocess.run(["gcc", "-O2", *STRICT, f"-I{folder() / 'mutant'}", "-pthread", "-o", made, source], check=True)
    return made


def test_without_the_zeroing_of_the_banks_number_values_are_torn(place: Path) -> None:
    """So the tests above can fail."""
    mutant = without_zeroing()
    with board(place) as python:
        with_item(python, LARGE)
        with running(place, mutant, "write", "value", LARGE):
            deadline = time.monotonic() + 120
            found = {"torn": 0}
            while not found["torn"] and time.monotonic() < deadline:
                with running(place, mutant, "read", "value", LARGE, 1_000) as reader:
                    found = counts(reader)
        assert found["torn"] > 0


# --- Files that lie --------------------------------------------------------------------------------------------------


def scribble(area: memoryview, dice: random.Random, fields: Sequence[tuple[int, int]]) -> None:
    """Overwrite a field of what a file says of itself, and mostly put it back."""
    at, size = dice.choice(fields)
    before = bytes(area[at : at + size])
    word = dice.choice((dice.getrandbits(64), 2**64 - 1, 0, 1 << dice.randrange(64), 2**64 - (1 << dice.randrange(64))))
    area[at : at + size] = word.to_bytes(8, "little")[:size]
    time.sleep(dice.random() * 0.0005)
    if dice.random() < 0.95:
        area[at : at + size] = before


def test_a_member_of_the_group_who_scribbles_into_the_file_crashes_no_program_in_c(place: Path) -> None:
    dice = random.Random(SEED)
    print(f"FAILOVER_SEED={SEED}")
    torn = program("board_torn")
    place.mkdir()
    directory.make_file(place / "private", layout.PRIVATE, "robot1")
    directory.make_file(place / "own", layout.OWN, "robot1")  # an agent's, which no program makes anew
    with board(place) as python:
        with_item(python, SMALL)
        file, record = python.found("value", python.robot)
        whole = bytes(file.view)
        header = [(0, 8), (8, 4), (12, 4), (16, 8), (24, 4), (28, 4), (32, 8), (40, 8)]
        declared = [(6, 2), (8, 8), (16, 4), (20, 4), (24, 4), (28, 4), (32, 8), (40, 8), (48, 8), (64, 8), (72, 2), (76, 4)]
        bank = [(0, 8), (8, 8), (16, 8), (24, 4), (28, 4)]
        fields = [*header, *((record.at + at, size) for at, size in declared * 3)]
        fields += [(record.offset + at, size) for at, size in bank]
        fields += [(layout.names_at(file.header.capacity), 2)]
        until = time.monotonic() + 8
        rounds = 0
        while time.monotonic() < until:
            file.view[:] = whole
            words = [torn, "both", "value", str(SMALL), "20000"]
            started = subprocess.Popen(words, env={**os.environ, "FAILOVER_BOARD": str(place)}, stdout=-3, stderr=-3)
            while started.poll() is None:
                scribble(file.view, dice, fields)
            assert started.returncode in (0, 1), f"it was killed by signal {-started.returncode}"
            rounds += 1
        assert rounds > 0
        file.view[:] = whole


def test_a_file_that_becomes_shorter_while_it_is_used_ends_no_program_in_c(place: Path) -> None:
    torn = program("board_torn")
    with board(place) as python:
        with_item(python, SMALL)
        with (
            running(place, torn, "write", "value", SMALL) as writer,
            running(place, torn, "read", "value", SMALL, 10**9) as reader,
        ):
            os.truncate(place / "own", 8192)
            assert writer.wait(60) == 1, "its put is refused in a sentence"
            assert reader.poll() is None
        shutil.rmtree(place)


def test_python_reads_what_c_scribbled_as_errors_in_sentences(place: Path) -> None:
    """Both clients believe the same: damage is refused in words."""
    with board(place) as python:
        with_item(python, SMALL)
        python.item("value").put(b"x" * SMALL)
        file, record = python.found("value", python.robot)
        file.view[record.at + 16 : record.at + 20] = (1 << 30).to_bytes(4, "little")
        file.words[2] += 2
        with pytest.raises(BoardError, match="damaged"):
            python.item("value")
        torn = program("board_torn")
        words = [torn, "read", "value", str(SMALL), "1"]
        done = subprocess.run(
            words, env={**os.environ, "FAILOVER_BOARD": str(place)}, capture_output=True, text=True, check=False
        )
        assert "damaged" in done.stderr
