"""Hostile files: whatever is written into a board's file, a program gets one clear error or a value, and never a crash."""

from __future__ import annotations

import contextlib
import os
import random
import struct
from collections.abc import Callable
from pathlib import Path

import pytest

import failover
from failover.boards.mapping import MappedFile
from failover.core.board import layout
from failover.core.board.items import Item
from failover.errors import BoardError, FailoverError
from tests.failover.boards.programs import program

SEED = int(os.environ.get("FAILOVER_SEED", str(random.randrange(1 << 32))))
TURNS = int(os.environ.get("FAILOVER_BOARD_SCRIBBLES", "100"))
LIMITS = [0, 1, 2, 3, 7, 2**15, 2**16, 2**31, 2**32 - 1, 2**63, 2**64 - 1, 65536, 65537, 1 << 24]

VICTIM = f"""
import random, struct, sys, os
from failover.core.board import layout
from failover.errors import FailoverError
seed, turns = {SEED}, {TURNS}
dice = random.Random(seed)
board.add(Item('ball', {{'x': 'f8', 'y': 'f4[3]'}})); board.add(Item('plan', 'msgpack', size=300))
board.add(Item('raw', size=64))
def use(opened):
    for name in ('ball', 'plan', 'raw'):
        item = opened.item(name)
        item.put({{'x': 1.0, 'y': [1, 2, 3]}} if name != 'raw' else b'x')
        item.get()
    opened.snapshot(), opened.users(), opened.names(), opened.robots()
use(board)
path = board.directory / 'own'
whole = path.read_bytes()
limits = {LIMITS} + [len(whole), len(whole) - 1, len(whole) - 64, layout.GONE]
errors, rights = 0, 0
kept = [board.item(name) for name in ('ball', 'plan', 'raw')]
board.close()
"""

SCRIBBLES = """
for turn in range(turns):
    folder = path.parent
    folder.mkdir(exist_ok=True)
    changed = bytearray(whole)
    struct.pack_into('<I', changed, 12, layout.OWN)  # an agent's: it is not removed
    path.write_bytes(changed)
    opened = failover.board()
    kept = [opened.item(name) for name in ('ball', 'plan', 'raw')]
    for item in kept: item.get()
    for _ in range(dice.choice((1, 1, 1, 3, 10))):
        places = dice.randrange(0, 160, 4), layout.RECORDS_AT + dice.randrange(0, 3 * 192, 4), dice.randrange(len(whole) - 8)
        at = dice.choice(places)
        size = dice.choice((1, 2, 4, 8))
        word = (dice.choice(limits) % 256**size).to_bytes(size, 'little')
        with open(path, 'r+b') as file:
            file.seek(at); file.write(word)
    calls = [item.get for item in kept] + [lambda item=item: item.put(b'y') for item in kept]
    calls += [lambda: use(failover.board()), opened.snapshot, opened.users, opened.names, opened.robots]
    calls += [lambda: opened.add(Item('more', size=9)), lambda: opened.remove('raw'), lambda: kept[0].wait(timeout=0)]
    for call in calls:
        try: call(); rights += 1
        except (FailoverError, TimeoutError) as error:
            errors += 1
            assert len(str(error)) > 10 and '\\n' not in str(error), repr(error)
    opened.close()
    path.unlink(missing_ok=True)
say(errors, rights)
(path.parent / 'private').unlink(missing_ok=True); path.parent.rmdir()
"""


def test_a_program_outlives_whatever_is_scribbled_into_the_file(place: Path) -> None:
    print(f"seed {SEED}")
    with program(VICTIM + SCRIBBLES) as victim:
        errors, rights = map(int, victim.hear().split())
        assert victim.process.wait() == 0
    assert errors > TURNS / 4 and rights > TURNS


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "it has 0 bytes"),
        (b"not a board" * 3000, "begins with"),
        (layout.MAGIC + b"\2" + bytes(40000), "version 2"),
        (bytes(40000), "not replaced yet"),
    ],
)
def test_a_file_that_is_no_board_is_refused_and_left_alone(place: Path, content: bytes, why: str) -> None:
    place.mkdir()
    own = place / "own"
    own.write_bytes(content)
    with pytest.raises(BoardError, match=why):
        failover.board()
    assert own.read_bytes() == content
    own.unlink()
    place.rmdir()


def test_a_place_that_cannot_be_is_refused(place: Path) -> None:
    for impossible, why in ((place / "deeper" / "board", "no directory can be made"), (Path("/proc/board"), "cannot make")):
        with pytest.raises(BoardError, match=why):
            failover.board(impossible)
    place.touch()
    with pytest.raises(BoardError, match="cannot open"):
        failover.board()
    place.unlink()


def test_another_boot_is_another_board(place: Path) -> None:
    with program("board.add(Item('x', size=8)); say('open'); hear()") as other:
        other.hear()
        other.kill()
    with open(place / "own", "r+b") as file:
        file.seek(40)
        file.write(bytes(16))
    with failover.board() as board:
        assert board.names() == []


def test_another_users_directory_at_the_usual_place_is_refused(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root can give a directory to another user")
    place.mkdir()
    os.chown(place, 12345, 12345)
    monkeypatch.delenv("FAILOVER_BOARD")
    monkeypatch.setattr("failover.boards.directory.find", lambda: place)
    with pytest.raises(BoardError, match="belongs to uid 12345"):
        failover.board()
    place.rmdir()


def test_a_stopped_holder_of_the_table_is_named_after_a_while(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("failover.boards.locks.TABLE_WAIT_S", 0.05)
    with failover.board() as board:
        item = board.add(Item("x", size=8))
        item.put(b"1")
        text = """
from failover.boards import locks
from failover.core.board.layout import TABLE_LOCK
own = board.ensured().own
own.words[2] += 1
say(locks.take(own.descriptor, TABLE_LOCK)); hear()
"""
        with program(text) as other:
            assert other.hear() == "True"
            with pytest.raises(BoardError, match="is it stopped"):
                board.add(Item("y", size=8))
            item.put(b"2")
            assert item.get().value == b"2"  # puts and gets wait for no table
            other.kill()
        board.add(Item("y", size=8))
        assert board.ensured().own.generation % 2 == 0


def test_programs_killed_while_they_add_leave_a_table_that_is_right(place: Path) -> None:
    """The child is killed at a random instruction of `add`; FAILOVER_BOARD_KILLS says how often."""
    dice = random.Random(SEED)
    kills = int(os.environ.get("FAILOVER_BOARD_KILLS", "20"))
    with failover.board() as board:
        kept = board.add(Item("kept", size=8))
        kept.put(b"kept")
        for turn in range(kills):
            read, write = os.pipe()
            pid = os.fork()
            if pid == 0:
                try:
                    with failover.board() as mine:
                        os.write(write, b"x")
                        for number in range(500):
                            mine.add(Item(f"item{turn}-{number}", size=8))
                            mine.remove(f"item{turn}-{number}")
                finally:
                    os._exit(0)
            os.close(write)
            os.read(read, 1)
            for _ in range(dice.randrange(3000)):
                pass
            os.kill(pid, 9)
            os.waitpid(pid, 0)
            os.close(read)
            file = MappedFile.open(board.directory / "own")
            header = file.read_header()
            assert all(record.offset + record.banks * record.stride <= header.file_size for record in file.records())
            file.close()
            kept.put(b"%d" % turn)
            assert kept.get().value == b"%d" % turn
            with contextlib.suppress(BoardError):  # the table has holes for 1,024 items only
                board.add(Item(f"after{turn}", size=8))
            assert board.ensured().own.generation % 2 == 0 or "after" not in "".join(board.names())


def as_nobody(act: Callable[[], str]) -> str:
    """What an act says in a process of user 65534; what it raised, if it did. Its modules are loaded already."""
    read, write = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            os.setgroups([])
            os.setgid(65534)
            os.setuid(65534)
            said = act()
        except (FailoverError, OSError) as error:
            said = f"{type(error).__name__}: {error}"
        os.write(write, said.encode())
        os._exit(0)
    os.close(write)
    os.waitpid(pid, 0)
    with os.fdopen(read) as pipe:
        return pipe.read()


root_only = pytest.mark.skipif(os.geteuid() != 0, reason="needs two users")


@root_only
def test_an_ordinary_user_has_a_board_of_his_own(place: Path) -> None:
    place.parent.chmod(0o777)

    def act() -> str:
        with failover.board() as board:
            item = board.add(Item("x", size=8))
            item.put(b"1")
            return f"{item.wait(after=0).value!r} {len(board.users())} {oct(os.stat(place / 'own').st_mode & 0o777)}"

    assert as_nobody(act) == "b'1' 1 0o600"
    assert not place.exists()


@root_only
def test_one_who_may_not_write_is_told_so(place: Path) -> None:
    place.parent.chmod(0o755)
    with failover.board() as board:
        board.add(Item("x", size=8)).put(b"1")
        board.directory.chmod(0o755)
        said = as_nobody(lambda: str(failover.board()))
        assert said.startswith("BoardError: cannot open") and "Permission denied" in said and "[board]" in said


def test_a_struct_of_another_size_is_damage(place: Path) -> None:
    with failover.board() as board:
        item = board.add(Item("x", {"a": "f8", "b": "f4[3]"}))
        item.put({"a": 1.0, "b": [1, 2, 3]})
        assert item.get().value["a"] == 1.0
        source = item.source()
        struct.pack_into("<I", source.file.area, source.place.banks[1] + 24, 8)
        with pytest.raises(BoardError, match="a value of 8 bytes where 24 to 24"):
            item.get()


def test_damage_in_a_size_word_is_one_error_and_a_new_put_heals_it(place: Path) -> None:
    with failover.board() as board:
        item = board.add(Item("x", size=8))
        item.put(b"1")
        source = item.source()
        bank = source.place.banks[1]
        struct.pack_into("<I", source.file.area, bank + 24, 1 << 30)
        with pytest.raises(FailoverError, match="damaged: a value of 1073741824 bytes"):
            item.get()
        item.put(b"2")
        assert item.get().value == b"2"
