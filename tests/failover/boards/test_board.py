"""A board without an agent: put, get, wait; who may write; who made it and who removes it."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import failover
from failover.boards import directory, fence
from failover.boards.board import Board
from failover.boards.mapping import MappedFile
from failover.core.board import layout
from failover.core.board.banks import put_carefully
from failover.core.board.items import Item
from failover.errors import (
    BoardError,
    ItemError,
    NeverWrittenError,
    OvertakenError,
    ValueMisfitError,
    WriterTakenError,
)
from tests.failover.boards.programs import program


@dataclass
class Ball:
    x: float
    y: float


@pytest.fixture
def board(place: Path) -> Board:
    return failover.board()


# --- Values ----------------------------------------------------------------------------------------------------------


def test_values_of_every_kind_come_back(board: Board) -> None:
    with board:
        board.add(Item("raw", size=400))
        board.add(Item("ball", Ball))
        board.add(Item("plan", "msgpack", size=200, banks=3))
        board.add(Item("grid", np.dtype(("f4", (2, 3)))))
        raw, ball = board.item("raw", bytes), board.item("ball", Ball)
        plan, grid = board.item("plan", "msgpack"), board.item("grid", np.dtype(("f4", (2, 3))))
        for turn in range(5):
            raw.put(bytes([turn]) * 379)
            ball.put(Ball(turn, 0.5))
            plan.put({"to": ["a", turn]})
            grid.put(np.full((2, 3), turn))
            assert (raw.get().value, ball.get().value) == (bytes([turn]) * 379, Ball(turn, 0.5))
            assert plan.get().value == {"to": ["a", turn]}
            assert (grid.get().value == turn).all()
            assert raw.get().number == turn + 1
        assert board.item("ball").get().value == {"x": 4.0, "y": 0.5}
        raw.put(b"")
        assert raw.get().value == b""
        raw.put(np.arange(3, dtype="u2"))  # not as many bytes as elements
        assert raw.get().value == np.arange(3, dtype="u2").tobytes()


def test_the_age_is_counted_from_the_instant_that_is_told(board: Board) -> None:
    with board:
        item = board.add(Item("raw", size=8, bound_ms=50))
        before = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        item.put(b"now")
        reading = item.get()
        after = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        assert 0 <= reading.age_ns == reading.age_max_ns <= after - before
        item.put(b"then", at=before - 1_000_000_000)
        reading = item.get()
        assert reading.age_ns >= 1_000_000_000 and reading.stale


@pytest.mark.parametrize("ahead_ns", [10**9, 10**18])
def test_an_instant_in_the_future_is_refused(board: Board, ahead_ns: int) -> None:
    with board:
        item = board.add(Item("raw", size=8))
        with pytest.raises(ValueMisfitError, match="in the future"):
            item.put(b"x", at=time.clock_gettime_ns(time.CLOCK_BOOTTIME) + ahead_ns)
        with pytest.raises(NeverWrittenError, match="'raw'"):
            item.get()


def test_what_does_not_fit_is_refused_counted_and_changes_nothing(board: Board) -> None:
    with board:
        board.add(Item("raw", size=8))
        board.add(Item("ball", Ball, finite=True))
        raw, ball = board.item("raw", bytes), board.item("ball", Ball)
        raw.put(b"12345678")
        ball.put(Ball(1, 2))
        for wrong in (b"123456789", "text", 5, None, [1000]):
            with pytest.raises(ValueMisfitError, match="item 'raw'"):
                raw.put(wrong)
        for wrong in (Ball(float("nan"), 1), "text", Ball("x", 1)):  # type: ignore[arg-type]
            with pytest.raises(ValueMisfitError, match="item 'ball'"):
                ball.put(wrong)
        assert (raw.get().value, raw.get().number) == (b"12345678", 1)
        assert (ball.get().value, ball.get().number) == (Ball(1, 2), 1)
        record = board.own_source("raw").record
        assert board.own_source("raw").place.words[(record.at + layout.REFUSED_FIELD) // 8] == 5


def test_another_type_is_refused_when_the_item_is_taken(board: Board) -> None:
    @dataclass
    class Other:
        x: int
        y: float

    with board:
        board.add(Item("ball", Ball))
        board.add(Item("raw", size=8))
        for name, shape in (("ball", Other), ("ball", "msgpack"), ("ball", bytes), ("raw", Ball), ("raw", "json")):
            with pytest.raises(ItemError, match=f"item '{name}'"):
                board.item(name, shape)


def test_an_item_that_is_not_declared_names_the_nearest(board: Board) -> None:
    with board:
        board.add(Item("ball", size=8))
        with pytest.raises(BoardError, match="did you mean 'ball'"):
            board.item("bal")
        with pytest.raises(BoardError, match=r"declare it in team.toml, or with board.add\(\)"):
            board.item("completely-else")
        with pytest.raises(BoardError, match=f"no robot 'robot9'.*it has {board.robot}"):
            board.item("ball").get("robot9")


def test_a_closed_board_says_so(board: Board) -> None:
    item = board.add(Item("raw", size=8))
    item.put(b"x")
    item.get()
    board.close()
    board.close()
    for call in (lambda: item.put(b"y"), item.get, lambda: board.item("raw"), board.robots, item.wait):
        with pytest.raises(BoardError, match="closed"):
            call()


# --- Items while it runs ---------------------------------------------------------------------------------------------


def test_items_are_added_and_removed_while_others_are_used(board: Board) -> None:
    with board, failover.board() as other:
        kept = board.add(Item("kept", size=100))
        kept.put(b"1")
        reader = other.item("kept")
        for turn in range(40):
            board.add(Item(f"item{turn}", size=4000, banks=8)).put(bytes([turn]) * 4000)
            assert other.item(f"item{turn}").get().value == bytes([turn]) * 4000
            kept.put(bytes([turn]))
            assert reader.get().value == bytes([turn])
        gone = other.item("item3")
        board.remove("item3")
        with pytest.raises(BoardError, match="no item 'item3'"):
            gone.get()
        with pytest.raises(BoardError, match="no item 'item3'"):
            board.item("item3")
        assert "item3" not in other.names()
        again = board.add(Item("item3", size=8))
        with pytest.raises(NeverWrittenError):
            again.get()
        assert reader.get().value == bytes([39])


def test_the_same_declaration_twice_is_one_item_and_another_is_refused(board: Board) -> None:
    with board, failover.board() as other:
        board.add(Item("ball", Ball)).put(Ball(1.0, 2.0))
        assert other.add(Item("ball", Ball)).get().value == Ball(1.0, 2.0)
        for declaration in (Item("ball", size=8), Item("ball", Ball, banks=3), Item("ball", Ball, shared=False)):
            with pytest.raises(BoardError, match="declared already"):
                other.add(declaration)


def test_add_returns_a_handle_for_values_of_the_declared_class(board: Board) -> None:
    with board:
        ball = board.add(Item("ball", Ball))
        ball.put(Ball(1.0, 2.0))
        assert ball.get().value == board.add(Item("ball", Ball)).get().value == Ball(1.0, 2.0)
        table = board.add(Item("ball", {"x": "f8", "y": "f8"}))
        assert table.get().value == {"x": 1.0, "y": 2.0}
        grid = board.add(Item("grid", np.dtype(("f4", (2, 3)))))
        grid.put(np.full((2, 3), 7))
        assert grid.get().value.shape == (2, 3)
        plan = board.add(Item("plan", "msgpack", size=20))
        plan.put([1, 2])
        assert plan.get().value == [1, 2]


def test_a_private_item_lies_in_a_file_of_its_own(board: Board) -> None:
    with board:
        board.add(Item("mine", size=8, shared=False)).put(b"x")
        assert [record.name for record in MappedFile.open(board.directory / "private").records()] == ["mine"]
        assert board.item("mine").get().value == b"x"
        assert board.snapshot()[board.robot]["mine"].value == b"x"


def test_a_full_board_is_refused(board: Board) -> None:
    with board:
        board.add(Item("first", size=8)).put(b"x")
        for turn in range(31):
            board.add(Item(f"item{turn}", size=65536, banks=8, shared=False))
        with pytest.raises(BoardError, match="fewer or smaller items"):
            board.add(Item("more", size=65536, banks=8, shared=False))
        board.add(Item("last", size=8))
        assert board.item("first").get().value == b"x"


# --- One writer ------------------------------------------------------------------------------------------------------


def test_a_second_writer_is_refused_and_told_who_writes(board: Board) -> None:
    with board:
        item = board.add(Item("ball", size=8))
        with program("board.item('ball').put(b'theirs'); say('put'); hear()") as other:
            other.hear()
            with pytest.raises(WriterTakenError, match=f"pid {other.pid}"):
                item.put(b"mine")
            assert item.get().value == b"theirs"
            other.kill()
        item.put(b"mine")
        assert (item.get().value, item.get().number) == (b"mine", 2)


def test_two_openings_in_one_process_are_two_writers(board: Board) -> None:
    with board, failover.board() as second:
        board.add(Item("ball", size=8)).put(b"x")
        with pytest.raises(WriterTakenError, match="another opening"):
            second.item("ball").put(b"y")


def test_two_handles_of_one_board_share_their_count(board: Board) -> None:
    with board:
        board.add(Item("ball", Ball))
        one, two = board.item("ball", Ball), board.item("ball")
        for turn in range(10):
            one.put(Ball(turn, 0))
            two.put({"x": turn + 0.5, "y": 1.0})
        assert (one.get().number, one.get().value) == (20, Ball(9.5, 1.0))


def test_threads_put_one_after_the_other(board: Board) -> None:
    with board:
        item = board.add(Item("ball", size=64))
        item.put(b"")
        interval = sys.getswitchinterval()
        sys.setswitchinterval(1e-6)
        try:
            threads = [threading.Thread(target=lambda n=n: [item.put(bytes([n]) * 64) for _ in range(2000)]) for n in range(4)]
            for thread in threads:
                thread.start()
            while any(thread.is_alive() for thread in threads):
                assert len(set(item.get().value)) <= 1
            for thread in threads:
                thread.join()
        finally:
            sys.setswitchinterval(interval)
        assert item.get().number == 8001


def test_a_put_inside_of_a_put_is_refused(board: Board) -> None:
    with board:
        item = board.add(Item("ball", size=8))
        item.put(b"first")
        errors = []

        def inside(*_: object) -> None:
            try:
                item.put(b"inner")
            except BoardError as error:
                errors.append(str(error))

        before = signal.signal(signal.SIGALRM, inside)
        try:
            signal.setitimer(signal.ITIMER_REAL, 0.0005, 0.0005)
            while not errors:
                item.put(b"outer")
            signal.setitimer(signal.ITIMER_REAL, 0)
        finally:
            signal.signal(signal.SIGALRM, before)
        assert "inside of a put" in errors[0]
        item.put(b"after")
        assert item.get().value == b"after"


def test_a_forked_child_is_a_user_and_a_writer_of_its_own(board: Board) -> None:
    with board:
        item = board.add(Item("ball", size=8))
        item.put(b"parent")
        read, write = os.pipe()
        child = os.fork()
        if child == 0:
            try:
                try:
                    item.put(b"child")
                    told = b"put"
                except WriterTakenError:
                    told = b"taken"
                os.write(write, told + b" " + item.get().value + b" " + str(len(board.users())).encode())
            finally:
                os._exit(0)
        os.waitpid(child, 0)
        assert os.read(read, 100) == b"taken parent 2"
        assert len(board.users()) == 1
        item.put(b"again")


# --- Users -----------------------------------------------------------------------------------------------------------


def test_users_are_counted_right_after_a_kill(board: Board) -> None:
    with board:
        assert [pid for pid, _, _ in board.users()] == [os.getpid()]
        text = "say(len(board.users())); hear()"
        with program(text) as one, program(text) as two:
            one.hear(), two.hear()
            assert {pid for pid, _, _ in board.users()} == {os.getpid(), one.pid, two.pid}
            one.kill()
            assert {pid for pid, _, _ in board.users()} == {os.getpid(), two.pid}
            two.tell("end")
            two.process.wait()
            assert {pid for pid, _, _ in board.users()} == {os.getpid()}


def test_the_last_user_removes_the_board_also_when_it_just_ends(place: Path) -> None:
    with program("board.add(Item('x', size=8)).put(b'1'); say('open'); hear()") as one:
        one.hear()
        with failover.board() as board:
            one.tell("end")
            one.process.wait()
            assert board.item("x").get().value == b"1"
        assert not place.exists()


def test_what_a_killed_last_user_left_is_replaced_by_the_next(place: Path) -> None:
    with program("board.add(Item('x', size=8)).put(b'1'); say('open'); hear()") as one:
        one.hear()
        one.kill()
    assert (place / "own").exists()
    with failover.board() as board:
        assert board.names() == []
    assert not place.exists()


def test_many_users_open_and_close_at_once(place: Path) -> None:
    text = """
for turn in range(60):
    with failover.board() as again:
        item = again.add(Item('x', size=8))
        assert item.name in again.names()
    if turn % 10 == 0:
        board.close() if board else None
        board = failover.board() if turn % 20 else None
if board: board.close()
say('done')
"""
    with program(text) as one, program(text) as two, program(text) as three:
        assert [each.hear() for each in (one, two, three)] == ["done"] * 3
        assert [each.process.wait() for each in (one, two, three)] == [0] * 3


def test_a_board_made_anew_is_found_by_those_who_had_the_old_one(board: Board) -> None:
    item = board.add(Item("x", size=8))
    item.put(b"old")
    fast_put, fast_get = item.put, item.get
    with board:
        own = MappedFile.open(board.directory / "own", writable=True)
        for path in (board.directory / "private", board.directory / "own"):
            path.unlink()
        own.words[2] = layout.GONE
        own.close()
        with failover.board() as other:
            assert other.names() == []
            with pytest.raises(NeverWrittenError):
                item.get()  # the program that had added it adds it again
            assert other.names() == ["x"]
            item.put(b"new")
            fast_put(b"newer")
            assert fast_get().value == item.get().value == other.item("x").get().value == b"newer"


def test_a_hole_in_place_of_the_mapping_opens_the_board_anew(place: Path) -> None:
    """As after a restore on another robot: private zeros at the same addresses."""
    text = """
import ctypes, mmap
own = failover.board()
item = own.add(Item('x', size=8)); item.put(b'old'); item.get()
fast_put, fast_get = item.put, item.get
libc = ctypes.CDLL(None, use_errno=True)
libc.mmap.restype = ctypes.c_void_p
libc.mmap.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_long)
for line in open('/proc/self/maps').read().splitlines():
    if str(own.directory) in line:
        low, high = (int(word, 16) for word in line.split()[0].split('-'))
        MAP_FIXED = 0x10
        assert libc.mmap(low, high - low, 3, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | MAP_FIXED, -1, 0) == low
say(fast_get().value)
fast_put(b'new')
say(fast_get().value, item.get().number)
own.close(); board.close()
"""
    with program(text) as one:
        assert (one.hear(), one.hear()) == ("b'old'", "b'new' 2")
        assert one.process.wait() == 0


# --- Other robots ----------------------------------------------------------------------------------------------------


def peer(board: Board, robot: str, *items: Item, state: int = layout.RUN) -> MappedFile:
    """What an agent has received from another robot."""
    return directory.make_peer(board.directory, robot, items=dict(enumerate(items)), rank=1, state=state)


def receive(file: MappedFile, name: str, number: int, value: bytes, age_ns: int = 0, error_us: int = 0) -> None:
    record = file.record(name)
    assert record is not None
    put_carefully(file.place(record), number, value, time.clock_gettime_ns(time.CLOCK_BOOTTIME) - age_ns, error_us)


def test_items_of_other_robots_are_read_with_both_bounds(board: Board) -> None:
    with board:
        declaration = Item("ball", Ball, bound_ms=500)
        board.add(declaration)
        ball = board.item("ball", Ball)
        file = peer(board, "robot2", declaration)
        with pytest.raises(NeverWrittenError, match="of robot2"):
            ball.get("robot2")
        packed = layout.struct.pack("<dd", 3.0, 4.0)
        receive(file, "ball", 1, packed, age_ns=20_000_000, error_us=1500)
        for _ in range(2):  # the slow way, then the fast one
            reading = ball.get("robot2")
            assert (reading.value, reading.robot, reading.number) == (Ball(3.0, 4.0), "robot2", 1)
            assert reading.age_ns >= 20_000_000
            assert reading.age_max_ns - reading.age_ns == 1_500_000
        receive(file, "ball", 2, packed, age_ns=499_000_000, error_us=5000)
        assert ball.get("robot2").stale
        ball.put(Ball(0, 0))
        assert ball.youngest().robot == board.robot
        receive(file, "ball", 3, packed, error_us=layout_no_bound())
        assert ball.get("robot2").age_max_ns > 10**18
        assert ball.youngest().robot == "robot2"
        assert set(board.snapshot()) == {board.robot, "robot2"}
        assert board.snapshot()["robot2"]["ball"].value == {"x": 3.0, "y": 4.0}
        assert board.robots()["robot2"].state == "run"


def layout_no_bound() -> int:
    from failover.core.board.ages import NO_ERROR_BOUND

    return NO_ERROR_BOUND


def test_a_robot_that_is_not_running_is_not_the_youngest(board: Board) -> None:
    with board:
        declaration = Item("x", size=8)
        item = board.add(declaration)
        file = peer(board, "robot2", declaration, state=layout.NOT)
        receive(file, "x", 1, b"theirs")
        with pytest.raises(NeverWrittenError, match="no robot"):
            item.youngest()
        file.set_word32(layout.STATE_AT, layout.RUN)
        assert item.youngest().value == b"theirs"


def test_the_learned_bound_makes_a_reading_stale(board: Board) -> None:
    with board:
        declaration = Item("x", size=8)
        item = board.add(declaration)
        file = peer(board, "robot2", declaration)
        receive(file, "x", 1, b"theirs", age_ns=50_000_000)
        assert [item.get("robot2").stale for _ in range(2)] == [False] * 2
        record = file.record("x")
        assert record is not None
        file.words[(record.at + layout.FORMULA_FIELD) // 8] = 40_000_000
        assert [item.get("robot2").stale for _ in range(2)] == [True] * 2


def test_the_kernel_lets_no_reader_write_into_another_robots_items(board: Board) -> None:
    with board:
        declaration = Item("x", size=8)
        item = board.add(declaration)
        receive(peer(board, "robot2", declaration), "x", 1, b"theirs")
        assert item.get("robot2").value == b"theirs"
        source = item.source("robot2")
        assert not source.file.is_writable
        with pytest.raises(TypeError):
            source.file.area[0:1] = b"x"
        with open("/proc/self/maps") as maps:
            rights = [line.split()[1] for line in maps if line.rstrip().endswith("peer-robot2")]
        assert "r--s" in rights


# --- Waiting ---------------------------------------------------------------------------------------------------------


def test_wait_returns_the_next_put_of_another_process(board: Board) -> None:
    with board:
        item = board.add(Item("x", size=8))
        with program("""
item = board.item('x')
while (line := hear()) != 'end': item.put(line.encode())
""") as other:
            other.tell("a")
            reading = item.wait(after=0)
            assert reading.value == b"a"
            for word in (b"b", b"c", b"d"):
                other.tell(word.decode())
                reading = item.wait(after=reading.number, timeout=60)
                assert reading.value == word
            with pytest.raises(TimeoutError, match="was not put within"):
                item.wait(after=reading.number, timeout=0.05)
            with pytest.raises(TimeoutError):
                item.wait(timeout=0)
            assert item.wait(after=1, timeout=0).value == b"d"


def test_a_put_wakes_a_sleeper_before_it_looks_by_itself(board: Board, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a slice of an hour only the wake-up can end the wait."""
    monkeypatch.setattr("failover.boards.item.SLICE_S", 3600.0)
    with board:
        item = board.add(Item("x", size=8))
        item.put(b"a")
        at = item.source().record.at + layout.WAITERS_FIELD
        got: list[bytes] = []
        thread = threading.Thread(target=lambda: got.append(item.wait(after=1).value))
        thread.start()
        asleep = Path(f"/proc/self/task/{thread.native_id}/wchan")
        while not (item.source().file.area[at] and "futex" in asleep.read_text()):
            time.sleep(0)
        item.put(b"b")
        thread.join()
        assert got == [b"b"]


class Asked:
    """The bytes of a file, in which the agent asks to be told as soon as they were looked at."""

    def __init__(self, area: memoryview, at: int) -> None:
        self._area, self._at = area, at

    def __getitem__(self, which: slice) -> bytes:
        found = bytes(self._area[which])
        self._area[self._at] = 1
        return found

    def __setitem__(self, at: int, byte: int) -> None:
        self._area[at] = byte


def test_a_question_of_the_agent_that_comes_while_a_put_wakes_others_is_kept(
    board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    with board:
        item = board.add(Item("x", size=8, urgent=True))
        item.put(b"a")
        file, at = item.source().file, item.source().record.at + layout.WAITERS_FIELD
        area, base = file.area, file.address(0)
        monkeypatch.setattr(MappedFile, "address", lambda _file, offset: base + offset)
        monkeypatch.setattr(MappedFile, "take_writer", lambda *_: True)  # it is taken already
        area[at] = 1  # a program waits for this item
        file.area = Asked(area, at + 1)
        board.writer("x").forget()  # it has the area of before
        item.put(b"b")
        file.area = area
        assert tuple(area[at : at + 2]) == (0, 1)


@pytest.mark.parametrize("asked", [0, 1])
def test_a_put_into_a_file_of_another_user_wakes_a_watch_that_cannot_say_that_it_waits(
    board: Board, monkeypatch: pytest.MonkeyPatch, asked: int
) -> None:
    """With a slice of an hour only the wake-up can end the wait."""
    monkeypatch.setattr("failover.boards.watch.SLICE_S", 3600.0)
    with board as writing:
        items = {0: Item("theirs", size=8)}
        directory.make_file(writing.directory / f"own+{os.geteuid()}", layout.OWN, writing.robot, items=items)
        with Board(writing.directory, "reads") as reading, Board(writing.directory, "puts") as putting:
            mine, theirs = reading.add(Item("mine", size=8)), reading.item("theirs")
            theirs.source().file.is_writable = False
            at = theirs.source().record.at + layout.WAITERS_FIELD
            watch = reading.watch(mine, theirs)
            got: list[str] = []
            thread = threading.Thread(target=lambda: got.extend(item.name for item, _ in watch.wait()))
            thread.start()
            asleep = Path(f"/proc/self/task/{thread.native_id}/wchan")
            while "futex" not in asleep.read_text():
                time.sleep(0)
            file = putting.item("theirs").source().file
            file.area[at + 1] = asked  # by a program of its user, for any of several
            putting.item("theirs").put(b"b")
            thread.join(60)
            assert got == ["theirs"]


def test_each_put_of_a_peer_wakes_too(board: Board) -> None:
    with board:
        declaration = Item("x", size=8)
        item = board.add(declaration)
        file = peer(board, "robot2", declaration)
        got: list[bytes] = []
        thread = threading.Thread(target=lambda: got.append(item.wait("robot2", after=0).value))
        thread.start()
        receive(file, "x", 1, b"theirs")
        thread.join()
        assert got == [b"theirs"]


def test_changes_yields_new_values(board: Board) -> None:
    async def first_three() -> list[bytes]:
        seen: list[bytes] = []
        item.put(b"before")
        changes = item.changes()
        task = asyncio.ensure_future(changes.__anext__())
        number = 0
        while len(seen) < 3:
            number += 1
            item.put(b"%d" % number)
            done, _ = await asyncio.wait([task], timeout=0.01)
            if done:
                seen.append(task.result().value)
                task = asyncio.ensure_future(changes.__anext__())
        task.cancel()
        await asyncio.wait([task])
        await changes.aclose()  # type: ignore[attr-defined]
        return seen

    with board:
        item = board.add(Item("x", size=8))
        seen = asyncio.run(first_three())
        assert b"before" not in seen and sorted(seen, key=int) == seen


def test_take_gives_each_put_once_to_each_handle(board: Board) -> None:
    with board:
        item, other = board.add(Item("x", size=8)), board.item("x")
        assert item.take() is None
        item.put(b"a")
        assert [reading and reading.value for reading in (item.take(), item.take(), other.take())] == [b"a", None, b"a"]
        item.put(b"b")
        assert item.take().value == b"b"  # type: ignore[union-attr]


# --- Processors that reorder -----------------------------------------------------------------------------------------


def test_with_fences_every_put_has_a_sum_and_every_get_examines_it(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on aarch64; that the fences are enough there is argued in BOARD.md, not shown here."""
    for module in ("item", "board"):
        monkeypatch.setattr(f"failover.boards.{module}.FENCE", fence._fence)
    with failover.board() as board:
        declaration = Item("x", size=64)
        item = board.add(declaration)
        for number in range(1, 6):
            item.put(b"%d" % number * 8)
            assert (item.get().value, item.get().number) == (b"%d" % number * 8, number)
        peer(board, "robot2", declaration)
        with pytest.raises(NeverWrittenError):
            item.get("robot2")
        source = item.source()
        bank = source.place.banks[5 % 2]
        assert source.place.words[bank // 8 + 2] != 0
        source.file.area[bank + 32] ^= 1
        with pytest.raises(OvertakenError, match="or by two at once"):
            item.get()
        item.put(b"whole")
        assert item.get().value == b"whole"


# --- Time namespaces -------------------------------------------------------------------------------------------------


YEARS_3_S = 3 * 365 * 86_400


def years_apart(seconds: int) -> list[str]:
    """A command that runs another one with its CLOCK_BOOTTIME so far ahead; skips where the kernel lets nobody."""
    for command in (["unshare", "--time", "--fork"], ["unshare", "--map-root-user", "--time", "--fork"]):
        whole = [*command, "--kill-child", "--boottime", str(seconds)]
        with contextlib.suppress(OSError):
            if subprocess.run([*whole, "true"], capture_output=True, check=False).returncode == 0:
                return whole
    pytest.skip("no time namespace can be made here")


def test_two_programs_whose_clocks_are_years_apart_tell_the_same_ages(place: Path) -> None:
    """One is three years ahead, this one is not; each tells the true age of the other's value."""
    text = """
item = board.item('x')
while hear() == 'tell':
    before = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    reading = item.get()
    say(before, reading.age_ns)
    before_put = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    board.item('theirs').put(b'y', at=before_put)
    say(before_put)
"""
    skew_ns = YEARS_3_S * 10**9
    with failover.board() as board:
        item, theirs = board.add(Item("x", size=8)), board.add(Item("theirs", size=8))
        with program(text, years_apart(YEARS_3_S)) as other:
            for _ in range(3):
                stamp = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
                item.put(b"x", at=stamp)
                other.tell("tell")
                begun, age_ns = map(int, other.hear().split())
                assert begun - skew_ns > stamp, "the clock inside is ahead by as much as was asked for"
                assert age_ns >= begun - skew_ns - stamp
                put_at = int(other.hear()) - skew_ns
                before = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
                reading = theirs.wait(after=0)
                after = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
                assert before - put_at <= reading.age_ns <= after - put_at
        while len(board.users()) > 1:  # unshare is dead, its child soon
            time.sleep(0)


# --- Epochs ----------------------------------------------------------------------------------------------------------


def test_numbers_of_a_later_epoch_are_above_all_of_an_earlier_one(place: Path) -> None:
    with failover.board() as board:
        item = board.add(Item("x", size=8))
        for epoch in (0, 3, 4):
            text = "item = board.item('x'); item.put(b'1'); item.put(b'2'); say('put'); hear()"
            os.environ["FAILOVER_EPOCH"] = f"{epoch:020}"
            try:
                with program(text) as other:
                    other.hear()
            finally:
                del os.environ["FAILOVER_EPOCH"]
            assert item.get().number == epoch * 2**40 + 2
