"""failover_board.h and failover_rtdb.h: C and Python exchange values on one board; refusals are sentences."""

from __future__ import annotations

import ctypes
import os
import select
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
import xxhash

from agent.system.inotify import Touches
from failover.boards import boottime, directory, futex
from failover.boards.board import Board, board
from failover.core.board import layout
from failover.core.board.banks import put_carefully, sum_of
from failover.core.board.items import Item as Declaration
from failover.core.board.layout import NOT, RUN, Wanted
from failover.errors import WriterTakenError
from tests.include.board_programs import EMULATOR, Tool, emulated_tool, place_for_board, tool
from tests.include.programs import STRICT, has

pytestmark = pytest.mark.compiler

NS_PER_MS = 1_000_000


@pytest.fixture
def place() -> Iterator[Path]:
    with place_for_board() as found:
        yield found


def age_of(answer: str) -> tuple[int, int]:
    """The two ages of an answer to "get"."""
    words = answer.split()
    return int(words[words.index("age") + 1]), int(words[words.index("max") + 1])


def added(python: Board, tool_: Tool, name: str = "ball", size: int = 379) -> None:
    """An item that both have."""
    tool_.ok("add", name, size)
    tool_.ok("find", name, size)
    assert python.item(name).name == name


# --- Values both ways ------------------------------------------------------------------------------------------------


def test_c_and_python_exchange_values_both_ways_on_one_board(place: Path) -> None:
    with board(place) as python, tool(place) as c:
        added(python, c, "ball")
        added(python, c, "plan")
        python.item("plan").put(b"forward")
        for turn in range(1, 6):
            c.ok("put", "ball", f"ball{turn}")
            reading = python.item("ball").get()
            assert (reading.value, reading.number) == (f"ball{turn}".encode(), turn)
            assert 0 <= reading.age_ns == reading.age_max_ns
            python.item("plan").put(f"plan{turn}".encode())
            answer = c.say("get", "plan", "-")
            assert answer.startswith(f"plan{turn} age ")
            assert f"number {turn + 1} " in answer
            assert 0 <= age_of(answer)[0] == age_of(answer)[1]


def test_an_age_told_by_c_is_the_true_one(place: Path) -> None:
    with board(place) as python, tool(place) as c:
        added(python, c)
        measured = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - 5000 * NS_PER_MS
        python.item("ball").put(b"old", at=measured)
        before = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - measured
        age, _ = age_of(c.say("get", "ball", "-"))
        assert before <= age <= time.clock_gettime_ns(time.CLOCK_BOOTTIME) - measured


def test_a_value_is_put_with_the_instant_at_which_it_was_measured(place: Path) -> None:
    with board(place) as python, tool(place) as c:
        added(python, c)
        measured = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - 700 * NS_PER_MS
        c.ok("put", "ball", "seen", measured)
        reading = python.item("ball").get()
        assert 700 * NS_PER_MS <= reading.age_ns <= time.clock_gettime_ns(time.CLOCK_BOOTTIME) - measured
        assert "in the future" in c.say("put", "ball", "seen", time.clock_gettime_ns(time.CLOCK_BOOTTIME) + 10**12)


def test_the_other_robots_items_are_read_with_both_ages_and_their_bound(place: Path) -> None:
    with board(place) as python, tool(place) as c:
        added(python, c)
        with_peer(python, place, "robot2", rank=1)
        answer = c.say("get", "ball", "robot2")
        assert answer.startswith("theirs age ")
        age, most = age_of(answer)
        assert most == age + 250_000
        assert answer.endswith("stale 1"), "its bound is 1 ms"
        assert "no robot robot3" in c.say("get", "ball", "robot3")
        assert "no robot ../own" in c.say("get", "ball", "../own")


def with_peer(python: Board, place: Path, robot: str, rank: int, state: int = RUN) -> None:
    """Another robot's file with one item, as an agent writes it."""
    file = directory.make_peer(place, robot, rank=rank, state=state)
    with file.changing():
        file.add(Wanted(0, "ball", 379, bound_ns=NS_PER_MS))
    record = file.record("ball")
    assert record is not None
    put_carefully(file.place(record), 7, b"theirs", boottime.now_ns(0) - 2 * NS_PER_MS, error_us=250)
    file.close()


def test_c_reads_the_youngest_value_of_the_robots_that_are_running(place: Path) -> None:
    with board(place) as python, tool(place) as c:
        added(python, c)
        added(python, c, "plan")
        assert "no robot that is running has put it" in c.say("youngest", "ball")
        with_peer(python, place, "robot3", rank=2, state=NOT)
        assert "no robot that is running has put it" in c.say("youngest", "ball")
        python.item("ball").put(b"mine", at=time.clock_gettime_ns(time.CLOCK_BOOTTIME) - 5000 * NS_PER_MS)
        assert c.say("youngest", "ball") == f"{python.robot} mine"
        with_peer(python, place, "robot2", rank=1)
        assert c.say("youngest", "ball") == "robot2 theirs"
        assert "no robot that is running has put it" in c.say("youngest", "plan"), "robot2 has no such item"
        directory.dismiss(place / "peer-robot2")
        assert c.say("youngest", "ball") == f"{python.robot} mine"
        python.item("ball").put(b"new")
        with_peer(python, place, "robot2", rank=1)
        reading = python.item("ball").youngest()
        assert c.say("youngest", "ball") == f"{reading.robot} {bytes(reading.value).decode()}"


def test_a_snapshot_by_c_is_that_of_python(place: Path) -> None:
    with board(place) as python, tool(place) as c:
        assert c.say("snapshot") == ""
        added(python, c, "ball")
        added(python, c, "plan")
        python.add(Declaration("secret", size=8, shared=False))
        python.item("secret").put(b"private")
        python.item("ball").put(b"mine", at=time.clock_gettime_ns(time.CLOCK_BOOTTIME) - 700 * NS_PER_MS)
        with_peer(python, place, "robot2", rank=1)
        before = python.snapshot()
        found: dict[str, dict[str, list[str]]] = {}
        for word in c.say("snapshot").split():
            name, _, rest = word.partition("=")
            robot, _, item = name.partition("/")
            found.setdefault(robot, {})[item] = rest.split("/")
        after = python.snapshot()
        assert set(found) == {python.robot, "robot2"}
        for robot, items in found.items():
            assert set(items) == set(before[robot])
            for item, (value, number, age, most, stale) in items.items():
                first, last = before[robot][item], after[robot][item]
                assert (value.encode(), int(number), bool(int(stale))) == (first.value, first.number, first.stale)
                assert first.age_ns <= int(age) <= last.age_ns
                assert first.age_max_ns - first.age_ns == int(most) - int(age)
        ages = [int(found[python.robot][name][2]) for name in ("ball", "secret")]
        apart = [before[python.robot][name].age_ns for name in ("ball", "secret")]
        assert ages[0] - ages[1] == apart[0] - apart[1], "all ages are of one instant"


def test_a_program_that_reads_all_robots_stays_the_writer_of_its_items(place: Path) -> None:
    """Also when another robot has left and come back, or is away."""
    with board(place) as python, tool(place) as c:
        added(python, c)
        with_peer(python, place, "robot2", rank=1)
        c.ok("put", "ball", "mine")
        for look in (("youngest", "ball"), ("get", "ball", "robot2"), ("snapshot",)):
            assert "theirs" in c.say("get", "ball", "robot2")
            directory.dismiss(place / "peer-robot2")
            with_peer(python, place, "robot2", rank=1)
            c.ok("put", "ball", "mine")
            assert ("mine" if look[0] == "youngest" else "theirs") in c.say(*look)
            with pytest.raises(WriterTakenError):
                python.item("ball").put(b"ours")
        directory.dismiss(place / "peer-robot2")
        assert "no robot robot2" in c.say("get", "ball", "robot2")
        assert "theirs" not in c.say("snapshot")
        with pytest.raises(WriterTakenError):
            python.item("ball").put(b"ours")
        assert python.item("ball").get().value == b"mine"


def test_a_program_that_opens_the_same_board_anew_stays_the_writer_of_its_items(place: Path) -> None:
    """What it has mapped stays mapped, and must not hold the locks of the opening before."""
    with board(place) as python, tool(place) as c:
        added(python, c)
        python.add(Declaration("secret", size=8, shared=False))
        python.item("secret").put(b"private")
        c.ok("put", "ball", "mine")
        c.ok("find", "secret", 8)
        assert "private" in c.say("get", "secret", "-")
        file, _ = python.found("secret", python.robot)
        file.words[layout.GENERATION_AT // 8] = layout.GONE
        assert "has no item secret" in c.say("get", "secret", "-")
        c.ok("put", "ball", "mine")
        with pytest.raises(WriterTakenError):
            python.item("ball").put(b"ours")


def test_snapshots_by_c_go_on_while_a_robot_comes_and_leaves(place: Path) -> None:
    with board(place) as python, tool(place) as c:
        added(python, c)
        python.item("ball").put(b"mine")
        ends = threading.Event()

        def come_and_go() -> None:
            while not ends.is_set():
                with_peer(python, place, "robot2", rank=1)
                directory.dismiss(place / "peer-robot2")

        comes = threading.Thread(target=come_and_go)
        comes.start()
        try:
            for _ in range(200):
                words = {word.partition("=")[0] for word in c.say("snapshot").split(" ") if word}
                assert words in ({f"{python.robot}/ball"}, {f"{python.robot}/ball", "robot2/ball"})
        finally:
            ends.set()
            comes.join()


# --- Waiting ---------------------------------------------------------------------------------------------------------


def test_c_waits_for_a_put_of_python_and_python_for_one_of_c(place: Path) -> None:
    with board(place) as python, tool(place) as c:
        added(python, c, "ball")
        added(python, c, "plan")
        assert "not put in time" in c.say("wait", "ball", "-", 0, 20)
        python.item("ball").put(b"1")
        c.ok("wait", "ball", "-", 0, 60_000)
        assert c.process.stdin is not None
        c.process.stdin.write("wait ball - 1 60000\n")
        c.process.stdin.flush()
        record = python.found("ball", python.robot)
        while not record[0].word32(record[1].at + layout.WAITERS_FIELD):
            time.sleep(0.001)
        python.item("ball").put(b"2")
        assert c.process.stdout is not None
        assert c.process.stdout.readline() == "ok\n"
        c.ok("put", "plan", "go")
        assert python.item("plan").wait(after=0, timeout=60).value == b"go"


def test_c_tells_an_agent_of_a_put_of_an_urgent_item_when_it_is_asked(place: Path) -> None:
    with board(place) as python, tool(place) as c:
        python.add(Declaration("alarm", size=8, urgent=True))
        c.ok("find", "alarm", 8)
        file, record = python.found("alarm", python.robot)
        with closing(Touches(file.descriptor)) as touches, closing(select.epoll()) as loop:
            loop.register(touches.fileno(), select.EPOLLIN)
            c.ok("put", "alarm", "1")
            assert not loop.poll(0), "no agent has asked"
            file.area[record.at + layout.WAITERS_FIELD + 1] = 1
            c.ok("put", "alarm", "2")
            assert loop.poll(60)
            assert file.area[record.at + layout.WAITERS_FIELD + 1] == 0


def test_c_waits_for_a_put_of_any_of_several_items_of_several_robots(place: Path) -> None:
    with board(place) as python, tool(place) as c:
        added(python, c, "ball")
        added(python, c, "plan")
        with_peer(python, place, "robot2", rank=1)
        python.item("plan").put(b"1")
        assert c.say("any", "plan", "-", 0, "ball", "robot2", 0, 60_000) == "item 0"
        assert c.say("any", "ball", "-", 0, "ball", "robot2", 0, "plan", "-", 1, 60_000) == "item 1"
        assert "none of the 3 items was put in time" in c.say("any", "ball", "-", 0, "ball", "robot2", 7, "plan", "-", 1, 20)
        assert "no robot robot3" in c.say("any", "ball", "-", 0, "ball", "robot3", 0, 60_000)
        assert "give 1 to 128" in c.say("any", 20)
        for turn, name in enumerate(("ball", "plan", "ball"), 1):
            file, record = python.found(name, python.robot)
            file.area[record.at + layout.WAITERS_FIELD + 1] = 0
            known = [python.item(one).get().number if turn > 1 or one == "plan" else 0 for one in ("ball", "plan")]
            assert c.process.stdin is not None
            c.process.stdin.write(f"any ball robot2 7 ball - {known[0]} plan - {known[1]} 60000\n")
            c.process.stdin.flush()
            while not file.area[record.at + layout.WAITERS_FIELD + 1]:
                time.sleep(0.001)
            python.item(name).put(b"%d" % turn)
            assert c.process.stdout is not None
            assert c.process.stdout.readline() == {"ball": "item 1\n", "plan": "item 2\n"}[name]


def test_of_several_items_that_are_put_all_the_time_each_has_its_turn(place: Path) -> None:
    with board(place) as python, tool(place) as c:
        for name in ("ball", "plan", "goal"):
            added(python, c, name)
            python.item(name).put(b"!")
        wanted = ("any", "ball", "-", 0, "plan", "-", 0, "goal", "-", 0, 60_000)
        assert sorted(c.say(*wanted) for _ in range(3)) == ["item 0", "item 1", "item 2"]


@pytest.mark.skipif(os.geteuid() != 0, reason="another user is needed")
def test_c_is_woken_by_a_put_into_a_file_that_another_user_writes(place: Path) -> None:
    with board(place) as python, tool(place, opened=False) as c:
        place.chmod(0o755)
        for path in place.iterdir():
            path.chmod(0o666)
        directory.make_file(place / "own+0", layout.OWN, python.robot, items={0: Declaration("theirs", size=8)}, mode=0o644)
        c.ok("user", 65534)
        c.ok("open")
        added(python, c)
        c.ok("find", "theirs", 8)
        with board(place) as putting:
            file, record = putting.found("theirs", python.robot)
            newest = file.address(record.at + layout.NEWEST_FIELD)
            assert c.process.stdin is not None and c.process.stdout is not None
            c.process.stdin.write("any ball - 0 theirs - 0 60000\n")
            c.process.stdin.flush()
            end = time.monotonic() + 30
            while woken(newest) != 1:
                assert time.monotonic() < end, "it does not sleep on the item of the other user"
                time.sleep(0.001)
            putting.item("theirs").put(b"!")
            assert c.process.stdout.readline() == "item 1\n"


def woken(address: int) -> int:
    """How many slept on a word, and are awake now."""
    return int(futex._call()(futex._number(), ctypes.c_void_p(address), futex._WAKE, futex._ALL, None, None, 0))


# --- Writers and users -----------------------------------------------------------------------------------------------


def test_an_item_has_one_writer_whichever_language_it_is_in_and_a_kill_frees_it(place: Path) -> None:
    with board(place) as python:
        with tool(place) as c:
            added(python, c)
            c.ok("put", "ball", "c")
            with pytest.raises(WriterTakenError, match=str(c.pid)):
                python.item("ball").put(b"python")
            assert "Device or resource busy" in c.say("child", "ball", "child"), "a child has not its parent's lock"
            c.ok("put", "ball", "c2")
        python.item("ball").put(b"python")
        assert python.item("ball").get().number == 3
        with tool(place) as c:
            c.ok("find", "ball", 379)
            assert f"is written by pid {os.getpid()}" in c.say("put", "ball", "c")


def test_users_in_c_are_counted_and_the_last_one_removes_the_board(place: Path) -> None:
    with tool(place) as c:
        with board(place) as python:
            assert {pid for pid, _, _ in python.users()} == {os.getpid(), c.pid}
            assert {name for _, _, name in python.users()} >= {"board_tool"}
        with tool(place, FAILOVER_COMPONENT="/lab/robot1/mapper") as other:
            with board(place) as python:
                assert (other.pid, os.geteuid(), "/lab/robot1/mapper") in python.users()
            other.kill()
        with board(place) as python:
            assert {pid for pid, _, _ in python.users()} == {os.getpid(), c.pid}
        c.ok("close")
        assert not place.exists()


def test_a_board_whose_last_user_was_killed_is_made_anew(place: Path) -> None:
    with tool(place) as c:
        c.ok("add", "ball", 10)
    assert (place / "own").exists()
    with tool(place) as c:
        assert "has no item ball" in c.say("find", "ball", 10)


def test_numbers_under_an_epoch_are_above_all_that_the_old_copy_wrote(place: Path) -> None:
    with board(place) as python, tool(place, FAILOVER_EPOCH=f"{5:020d}") as c:
        added(python, c)
        c.ok("put", "ball", "x")
        assert python.item("ball").get().number == 5 * 2**40 + 1
        c.ok("put", "ball", "x")
        assert python.item("ball").get().number == 5 * 2**40 + 2


# --- The board changes -----------------------------------------------------------------------------------------------


def test_c_goes_on_while_others_add_and_remove_items(place: Path) -> None:
    with board(place) as python, tool(place) as c:
        added(python, c)
        for index in range(40):
            c.ok("put", "ball", f"v{index}")
            with tool(place) as other:
                other.ok("add", f"more{index}", 4000)
            c.ok("find", f"more{index}", 4000) if index < 10 else None
            assert c.say("get", "ball", "-").startswith(f"v{index} ")
        python.remove("ball")
        assert "has no item ball" in c.say("get", "ball", "-")
        assert "has no item ball" in c.say("put", "ball", "x")
        c.ok("add", "ball", 20)
        c.ok("put", "ball", "again")


def test_a_board_that_was_made_anew_is_opened_anew_at_the_next_call(place: Path) -> None:
    with tool(place) as c:
        c.ok("add", "ball", 20)
        c.ok("find", "ball", 20)
        c.ok("put", "ball", "before")
        own = os.open(place / "own", os.O_RDWR)
        os.pwrite(own, layout.WORD.pack(layout.GONE), layout.GENERATION_AT)
        os.close(own)
        shutil.rmtree(place)
        assert "never written" in c.say("get", "ball", "-"), "what the program had added is added again"
        c.ok("put", "ball", "after")
        with board(place) as python:
            assert python.item("ball").get().value == b"after"
            assert (c.pid, os.geteuid(), "board_tool") in python.users()


def test_a_change_of_the_table_whose_process_was_killed_hinders_no_one(place: Path) -> None:
    with board(place) as python, tool(place) as c:
        added(python, c)
        c.ok("put", "ball", "x")
        file, _ = python.found("ball", python.robot)
        file.words[2] += 1
        assert c.say("get", "ball", "-").startswith("x ")
        assert file.generation % 2 == 0
        c.ok("put", "ball", "y")


def test_an_item_of_another_type_is_refused_with_both(place: Path) -> None:
    with board(place) as python, tool(place) as c:
        text = "{x:f4,y:f4}"
        c.ok("add", "pose", 8, "own", text)
        c.ok("find", "pose", 8, f"{xxhash.xxh3_64_intdigest(text.encode()):016x}")
        c.ok("add", "raw", 16)
        assert python.item("raw", bytes).name == python.add(Declaration("raw", size=16)).name, "both declare it alike"
        assert "has another type" in c.say("find", "pose", 8, f"{1:016x}")
        assert "has values of 8 bytes; this program means 9" in c.say("find", "pose", 9)
        assert "a value of 3 bytes; the item holds 8" in c.say("put", "pose", "abc")
        python.add(Declaration("twist", {"x": "f4", "y": "f4"}))
        python.item("twist").put({"x": 1.5, "y": 2.5})
        c.ok("find", "twist", 8, f"{xxhash.xxh3_64_intdigest(text.encode()):016x}")
        assert " number 1 " in c.say("get", "twist", "-")
        assert "declared otherwise already" in c.say("add", "pose", 8, "own", "{x:f4,z:f4}")


def test_bad_arguments_are_refused_in_a_sentence(place: Path) -> None:
    with tool(place) as c:
        for words in (
            ("find", "x" * 64, 3),
            ("add", "x" * 64, 3),
            ("add", "none", 0),
            ("add", "large", 65537, "private"),
            ("add", "shared", 4097),
        ):
            assert "cannot" in c.say(*words)
        c.ok("close")
        assert "cannot make the board" in c.say("open", "/proc/no/such")


@pytest.mark.parametrize("content", [b"", b"\x89FOBRD\r\n", bytes(30000), b"\x89FOBRD\r\n" + b"\x07" * 40000, b"x" * 70000])
def test_a_file_that_is_no_board_is_refused_in_a_sentence(place: Path, content: bytes) -> None:
    place.mkdir()
    (place / "own").write_bytes(content)
    with tool(place, opened=False) as c:
        assert "board" in c.say("open")
    assert (place / "own").read_bytes() == content


def test_the_digest_is_xxh3(place: Path) -> None:
    data = bytes((index * 131 + (index >> 8)) & 255 for index in range(70000))
    with tool(place, opened=False) as c:
        for size in [*range(1200), 4096, 65535, 65536]:
            assert int(c.say("digest", size), 16) == xxhash.xxh3_64_intdigest(data[:size]), size


def test_the_sums_of_c_are_those_of_python_and_a_value_that_does_not_match_is_not_read(place: Path) -> None:
    with board(place) as python, tool(place, sums=True) as c:
        added(python, c)
        c.ok("put", "ball", "x" * 379)
        assert python.item("ball").get().value == b"x" * 379
        file, record = python.found("ball", python.robot)
        bank = file.place(record).banks[1]
        assert file.words[bank // 8 + 2] == sum_of(b"x" * 379, file.words[bank // 8 + 1], 1)
        assert c.say("get", "ball", "-").startswith("x" * 379)
        file.area[bank + 32 + 100 : bank + 32 + 101] = b"y"
        assert "written 16 times" in c.say("get", "ball", "-")


def test_a_program_for_aarch64_and_python_exchange_values_on_one_board(place: Path) -> None:
    """Emulated: so it shows the layout, not the order of loads and stores."""
    for needed in ("aarch64-linux-gnu-gcc", EMULATOR):
        if not has(needed):
            pytest.skip(f"needs {needed}, which is not installed here")
    with board(place) as python, emulated_tool(place) as c:
        added(python, c)
        c.ok("put", "ball", "hello")
        assert python.item("ball").get().value == b"hello"
        c.ok("add", "plan", 20)
        c.ok("find", "plan", 20)
        python.item("plan").put(b"go")
        assert c.say("get", "plan", "-").startswith("go age ")
        assert {c.pid, os.getpid()} == {pid for pid, _, _ in python.users()}


# --- CAMBADA's names -------------------------------------------------------------------------------------------------


def test_the_database_of_cambada_by_numbers(place: Path) -> None:
    with board(place) as python, tool(place) as c:
        assert c.say("db", "put", 1024, "x") == "-1", "before DB_init"
        assert c.say("db", "who") == "-1"
        with tool(place) as other:
            other.ok("add", "ball", 379)
        with_peer(python, place, "robot2", rank=1)
        assert c.say("db", "init") == "0"
        assert c.say("db", "init") == "0"
        assert c.say("db", "who") == "0"
        assert c.say("db", "get", "-", 1024).split()[0] == "-1", "never written"
        assert c.say("db", "put", 1024, "mine") == "0"
        life, value = c.say("db", "get", "-", 1024).split()
        assert (int(life) >= 0, value) == (True, "mine")
        assert c.say("db", "get", 0, 1024).split()[1] == "mine"
        assert python.item("ball").get().value.rstrip(b"\0") == b"mine"
        life, value = c.say("db", "get", 1, 1024).split()
        assert (int(life) >= 2, value) == (True, "theirs")
        for words in ((5, 1024), (-7, 1024), (0, 77), (0, -1)):
            assert c.say("db", "get", *words).split()[0] == "-1"
        assert c.say("db", "put", 77, "x") == "-1"
        assert c.say("db", "free") == "0"
        assert c.say("db", "put", 1024, "x") == "-1"


def test_a_program_of_a_signal_free_past_ends_by_a_bus_error_that_is_not_ours(place: Path, tmp_path: Path) -> None:
    """The guard against files that become shorter hands other bus errors on."""
    other = tmp_path / "other"
    other.write_bytes(b"x")
    source = tmp_path / "bus.c"
    source.write_text(
        '#include "failover_board.h"\n'
        "int main(int count, char **words) {\n"
        "    int file = open(words[count - 1], O_RDWR);\n"
        "    char *map = (char *)mmap(NULL, 8192, PROT_READ, MAP_SHARED, file, 0);\n"
        "    return fb_open(NULL) == NULL ? 3 : map[4096];\n"
        "}\n"
    )
    made = tmp_path / "bus"
    subprocess.run(["gcc", *STRICT, "-Iinclude", "-o", made, source], check=True, cwd=Path(__file__).parents[2])
    done = subprocess.run([made, other], env={"FAILOVER_BOARD": str(place)}, check=False)
    assert done.returncode == -signal.SIGBUS


def test_the_example_of_the_manual_compiles_and_runs(place: Path, tmp_path: Path) -> None:
    root = Path(__file__).parents[2]
    section = (root / "docs" / "c.md").read_text().split("\n## The team's board\n")[1]
    (tmp_path / "example.c").write_text(section.split("```c\n")[1].split("```")[0])
    made = tmp_path / "example"
    subprocess.run(["gcc", *STRICT, f"-I{root / 'include'}", "-pthread", "-o", made, tmp_path / "example.c"], check=True)
    environment = {"FAILOVER_BOARD": str(place)}
    done = subprocess.run([made], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "has no item ball" in done.stderr
    with board(place) as python:
        ball = python.add(Declaration("ball", {"x": "f4", "y": "f4", "seen": "u4"}))
        done = subprocess.run([made], env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0
        assert "no robot robot2" in done.stderr
        assert ball.get().value == {"x": 1.0, "y": 2.0, "seen": 1}
