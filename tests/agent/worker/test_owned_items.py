"""Items that one user alone may put: the agent gives each such user a file, and the kernel refuses all others.

Programs here are real processes of other users, members of the board's group.
"""

from __future__ import annotations

import contextlib
import errno
import grp
import mmap
import os
import pwd
import signal
import struct
import subprocess
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

import pytest

import failover
from agent.main_loop.board_link import BoardLink
from agent.main_loop.own_items import LOOK_NS
from agent.system import clock
from agent.worker import board_directory
from failover.boards import directory
from failover.boards.agents_file import AgentsFile
from failover.boards.board import Board
from failover.boards.mapping import MappedFile
from failover.boards.overview import overview
from failover.cli.main import main
from failover.core.board import layout
from failover.core.board.items import Item
from failover.core.board.layout import wanted_of
from failover.core.board.owners import Owner
from tests.agent.worker.test_board_directory import BALL, boards_of, folder, found, loaded

__all__ = ["folder", "found"]

MAPPER, PLANNER = "daemon", "bin"
"""Users that each system has."""
UID, OTHER = pwd.getpwnam(MAPPER).pw_uid, pwd.getpwnam(PLANNER).pw_uid
GROUP = "games"
OWNED = f"""
[board]
group = "{GROUP}"
{BALL}
[board.items.map]
type = {{ n = "u8" }}
user = "{MAPPER}"
[board.items.plan]
size = 8
user = "{PLANNER}"
[board.items.secret]
size = 9000
shared = false
user = "{MAPPER}"
"""

needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="needs other users")


def as_user(uid: int, act: Callable[[], object], group: str = GROUP) -> None:
    """Do that in a process of another user, a member of the board's group; what goes wrong there goes wrong here."""
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        status = 1
        try:
            os.setgroups([grp.getgrnam(group).gr_gid])
            os.setgid(65534)
            os.setuid(uid)
            act()
            status = 0
        finally:
            if status:
                os.write(writing, traceback.format_exc()[-3000:].encode())
            os._exit(status)
    os.close(writing)
    with open(reading) as said:
        complaint = said.read()
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0, complaint


def number_of(place: Path) -> int:
    with Board(place, "test") as board:
        return int(board.item("map").get().value["n"])


def put(place: Path, name: str, value: object) -> None:
    with Board(place, "test") as board:
        board.item(name).put(value)


def refused(place: Path, name: str, value: object) -> str:
    with pytest.raises(failover.BoardError) as caught:
        put(place, name, value)
    return str(caught.value)


@pytest.fixture
def place(folder: Path, found: None) -> Path:
    made = board_directory.provide(loaded(folder, OWNED))
    assert made is not None
    return made


WITHOUT_CAPABILITIES = ("setpriv", "--bounding-set=-all", "--inh-caps=-all", sys.executable, "-c")
PROVIDE = """
import sys
from pathlib import Path
from agent import config
from agent.worker import board_directory
assert "CapEff:\\t0000000000000000" in Path("/proc/self/status").read_text()
board_directory.provide(config.load(Path(sys.argv[1])), print)
"""


@needs_root
def test_an_agent_without_any_capability_makes_and_adopts_the_files(folder: Path, found: None) -> None:
    """As under systemd: root's files are all that it has."""
    loaded(folder, OWNED.replace(f'group = "{GROUP}"', ""))
    place = board_directory.place_of(loaded(folder))
    made = []
    for _ in range(2):
        words = [*WITHOUT_CAPABILITIES, PROVIDE, folder / "agent.toml"]
        ran = subprocess.run(words, capture_output=True, text=True, check=False)
        assert (ran.returncode, ran.stdout) == (0, ""), ran.stdout + ran.stderr
        made.append((place / f"own+{UID}").stat().st_ino)
    assert made[0] == made[1] and (place / f"own+{UID}").stat().st_uid == 0
    root = grp.getgrgid(os.getegid()).gr_name
    as_user(UID, lambda: put(place, "map", {"n": 7}), root)
    as_user(OTHER, lambda: _equal((number_of(place), "alone may put it" in refused(place, "map", {"n": 8})), (7, True)), root)


@needs_root
def test_its_user_puts_an_item_all_get_it_and_the_kernel_refuses_the_put_of_others(place: Path) -> None:
    as_user(UID, lambda: put(place, "map", {"n": 7}))
    as_user(UID, lambda: put(place, "secret", b"s"))
    as_user(OTHER, lambda: put(place, "plan", b"p"))
    as_user(OTHER, lambda: put(place, "ball", {"x": 1.0, "y": 2.0}))

    def another() -> None:
        assert number_of(place) == 7
        said = refused(place, "map", {"n": 8})
        assert (
            said
            == f"item 'map' cannot be put: user '{MAPPER}' (uid {UID}) alone may put it, and this program runs as uid {OTHER}"
        )
        for flags in (os.O_RDWR, os.O_WRONLY):
            with pytest.raises(PermissionError) as caught:
                os.open(place / f"own+{UID}", flags)
            assert caught.value.errno == errno.EACCES
        with pytest.raises(PermissionError):
            os.chmod(place / f"own+{UID}", 0o666)
        with pytest.raises(PermissionError):
            os.unlink(place / f"own+{UID}")
        opened = os.open(place / f"own+{UID}", os.O_RDONLY)
        with pytest.raises(PermissionError):
            mmap.mmap(opened, 4096, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE)
        with Board(place, "test") as board:
            assert sorted(board.names()) == ["ball", "map", "notes", "plan", "secret"]
            with pytest.raises(failover.BoardError, match="cannot remove item 'map'"):
                board.remove("map")

    as_user(OTHER, another)
    assert number_of(place) == 7


@needs_root
def test_a_put_by_hand_as_another_user_is_one_sentence_that_names_the_user(
    place: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    as_user(UID, lambda: put(place, "map", {"n": 7}))
    assert main(["board", "get", "map", "--board", str(place)]) == 0  # loads what another user need not find the way to
    capfd.readouterr()
    as_user(OTHER, lambda: _equal(main(["board", "put", "map", '{"n": 8}', "--board", str(place)]), 1))
    said = capfd.readouterr().err
    assert said.count("\n") == 1
    assert f"item 'map' cannot be put: user '{MAPPER}' (uid {UID}) alone may put it, and this program runs as uid " in said
    as_user(OTHER, lambda: _equal(main(["board", "get", "map", "--board", str(place)]), 0))
    assert '"n": 7' in capfd.readouterr().out
    as_user(UID, lambda: _equal(main(["board", "put", "map", '{"n": 9}', "--board", str(place)]), 0))
    assert number_of(place) == 9


@needs_root
def test_a_user_who_is_no_member_of_the_group_reads_nothing_and_the_user_cannot_open_the_file_to_others(place: Path) -> None:
    def mapper() -> None:
        with pytest.raises(PermissionError):
            os.chmod(place / f"own+{UID}", 0o666)
        with pytest.raises(PermissionError):
            os.setxattr(place / f"own+{UID}", "system.posix_acl_access", b"\2\0\0\0")

    as_user(UID, mapper)
    pid = os.fork()
    if pid == 0:
        os.setgroups([])
        os.setgid(65534)
        os.setuid(OTHER)
        os._exit(0 if not os.access(place / f"own+{UID}", os.R_OK) else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


@needs_root
def test_what_a_member_of_the_group_writes_into_own_changes_no_reading_of_the_item(place: Path) -> None:
    """Neither a record of that name in `own` or `private`, nor one in the file of another user."""
    as_user(UID, lambda: put(place, "map", {"n": 7}))

    def impostor(name: str) -> Callable[[], None]:
        def write() -> None:
            file = MappedFile.open(place / name, writable=True)
            with file.changing():
                if file.header.count < file.header.capacity:
                    file.add(wanted_of(Item("map", size=8), 0))
                else:  # in the place of the one that stands there
                    at = int(layout.DECLARATION.unpack_from(file.view, file.records()[0].at)[9])
                    text = b"bytes[8]"
                    named = layout.LENGTH.pack(3) + b"map" + layout.LENGTH.pack(len(text)) + text
                    file.area[at : at + len(named)] = named
            record = next(one for one in file.records() if one.name == "map")
            bank = record.offset + record.stride
            struct.pack_into("<QQQIIQ", file.area, bank, 1, 1, 0, 8, 0, 666)
            file.words[(record.at + layout.NEWEST_FIELD) // 8] = 1

        return write

    as_user(OTHER, impostor("own"))
    as_user(OTHER, impostor("private"))
    as_user(OTHER, impostor(f"own+{OTHER}"))
    as_user(OTHER, lambda: _equal(number_of(place), 7))
    as_user(UID, lambda: _equal(number_of(place), 7))
    with Board(place, "test") as board:
        assert board.snapshot()["robot1"]["map"].value == {"n": 7}
        assert sorted(board.names()) == ["ball", "map", "notes", "secret"]
        assert board.item("map").source().file.path.name == f"own+{UID}"


def _equal(one: object, other: object) -> None:
    assert one == other


@needs_root
def test_a_file_that_its_user_has_spoilt_harms_no_other_item_and_is_whole_again_with_the_next_agent(
    folder: Path, place: Path
) -> None:
    def spoil() -> None:
        os.truncate(place / f"own+{UID}", 100)

    as_user(UID, spoil)

    def another() -> None:
        put(place, "plan", b"p")
        put(place, "ball", {"x": 1.0, "y": 2.0})
        with Board(place, "test") as board:
            with pytest.raises(failover.BoardError, match="it has 100 bytes"):
                board.item("map")
            assert board.item("plan").get().value == b"p"

    as_user(OTHER, another)
    said = board_directory.damaged_files(place)
    assert len(said) == 1 and said[0].startswith(f"user '{MAPPER}' has damaged the file of that user's items, which are not sent")
    assert "it has 100 bytes" in said[0]
    board_directory.provide(loaded(folder))
    assert board_directory.damaged_files(place) == []

    def damage() -> None:
        file = MappedFile.open(place / f"own+{UID}", writable=True)
        struct.pack_into("<H", file.area, file.records()[0].at + layout.BANKS_FIELD, 99)

    with Board(place, "opened before") as board:
        as_user(UID, damage)
        assert board.item("plan").get().value == b"p"
        board.add(Item("fresh", size=8)).put(b"f")
        with pytest.raises(failover.BoardError, match=f"own.{UID}: damaged: record 0 has 99 banks"):
            board.item("map")
        assert sorted(board.names()) == ["ball", "fresh", "notes", "plan"]
        assert set(board.snapshot()["robot1"]) == {"ball", "fresh", "plan"}
        with pytest.raises(failover.BoardError, match="did you mean 'plan'"):
            board.item("plam")
        said = {one.item: one.complaint for one in overview(board) if one.robot == "robot1"}
        assert {name for name, complaint in said.items() if "record 0 has 99 banks" in complaint} == {"map", "secret"}
        assert set(said) == {"ball", "fresh", "map", "notes", "plan", "secret"}
    board_directory.provide(loaded(folder))
    as_user(UID, lambda: put(place, "map", {"n": 8}))
    with Board(place, "test") as board:
        assert (board.item("map").get().value, board.item("plan").get().value) == ({"n": 8}, b"p")


def test_an_item_whose_robots_leave_this_one_out_is_its_users_here_too(folder: Path, found: None) -> None:
    told: list[str] = []
    me = pwd.getpwuid(os.geteuid()).pw_name
    items = f'[board.items.map]\nsize = 8\nuser = "{me}"\nrobots = ["robot2"]\n[board.items.mine]\nsize = 8\nuser = "{me}"\n'
    place = board_directory.provide(loaded(folder, BALL + items), told.append)
    assert place is not None and not told
    assert AgentsFile(place).owners() == {"map": Owner(2, me, None), "mine": Owner(3, me, os.geteuid())}
    with Board(place, "test") as board:
        assert sorted(board.names()) == ["ball", "mine", "notes"]
        item = board.add(Item("map", size=8))  # robot2's: declared alike already
        with pytest.raises(failover.BoardError, match=r"or its robots in team\.toml leave robot1 out"):
            item.put(b"fake")
        file = board.ensured().own
        with file.changing():
            file.add(wanted_of(Item("map", size=8), file.next_id(), layout.ADDED))
        with pytest.raises(failover.BoardError, match="leave robot1 out"):
            item.put(b"fake")
        assert sorted(board.names()) == ["ball", "mine", "notes"]
    with contextlib.closing(BoardLink.open(place, 20_000_000)) as link:
        told_items = [link.due(round_, clock.now_ns() + round_ * LOOK_NS) for round_ in range(1, 6)]
        assert not any(b"map" in portion.value for told_ in told_items for portion in told_)


@needs_root
def test_a_value_that_its_user_has_damaged_hides_no_other_value(place: Path) -> None:
    put(place, "ball", {"x": 1.0, "y": 2.0})
    as_user(OTHER, lambda: put(place, "plan", b"p"))
    as_user(UID, lambda: put(place, "map", {"n": 7}))

    def damage() -> None:
        file = MappedFile.open(place / f"own+{UID}", writable=True)
        record = file.record("map")
        assert record is not None
        bank = record.offset + record.stride
        struct.pack_into("<I", file.area, bank + 24, 1 << 30)

    as_user(UID, damage)
    with Board(place, "test") as board:
        assert set(board.snapshot()["robot1"]) == {"ball", "plan"}
        with pytest.raises(failover.BoardError):
            board.item("map").get()


@needs_root
def test_a_program_that_uses_no_item_of_a_user_outlives_that_he_makes_his_file_shorter(place: Path) -> None:
    """Root stands for him; the program is a process of its own, because the kernel would end it."""
    pid = os.fork()
    if pid == 0:
        with contextlib.suppress(Exception):
            with Board(place, "test") as board:
                board.item("ball").put({"x": 1.0, "y": 2.0})
                os.truncate(place / f"own+{UID}", 0)
                board.item("ball").put({"x": 3.0, "y": 4.0})
                board.add(Item("fresh", size=8)).put(b"f")
            os._exit(0)
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


def test_where_the_agent_makes_the_private_file_alone_anew_a_program_goes_there(folder: Path, found: None) -> None:
    place = board_directory.provide(loaded(folder, BALL))
    assert place is not None
    with Board(place, "test") as board:
        board.item("notes").put(["a"])
        directory.retire(place / "private")
        board_directory.provide(loaded(folder))
        board.add(Item("fresh", size=8, shared=False)).put(b"f")
        board.item("notes").put(["b"])
        assert board.names() == ["ball", "notes", "fresh"]


def test_a_file_that_is_made_shorter_while_it_is_mapped_is_told_in_a_sentence(
    folder: Path, found: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = board_directory.provide(loaded(folder, BALL))
    assert place is not None
    long = os.stat_result((*(place / "own").stat()[:6], 1 << 23, *(place / "own").stat()[7:]))
    with monkeypatch.context() as patch:  # what fstat(2) said a moment ago
        patch.setattr(os, "fstat", lambda _: long)
        with pytest.raises(failover.BoardError, match=r"cannot map .*own: mmap length is greater than file size"):
            MappedFile.open(place / "own")


def shortening(path: Path) -> int:
    """A process of the file's user that makes it shorter and whole again without a pause, also each new one."""
    pid = os.fork()
    if pid == 0:
        os.setgroups([])
        os.setgid(65534)
        os.setuid(UID)
        while True:
            with contextlib.suppress(OSError), open(path, "rb+", buffering=0) as file:
                content = os.pread(file.fileno(), 1 << 20, 0)
                while os.fstat(file.fileno()).st_nlink:
                    os.ftruncate(file.fileno(), 0)
                    os.pwrite(file.fileno(), content, 0)
    return pid


@needs_root
def test_a_user_who_makes_his_file_shorter_all_the_time_ends_no_agent(folder: Path, place: Path) -> None:
    """Neither the worker, which examines the file, nor the main loop, which opens it; each try is a process of its own."""

    def agents() -> None:
        settings = loaded(folder)
        for _ in range(10):
            board_directory.provide(settings)
            BoardLink.open(place, 20_000_000).close()

    hostile = shortening(place / f"own+{UID}")
    try:
        for _ in range(20):
            pid = os.fork()
            if pid == 0:
                with contextlib.suppress(BaseException):
                    agents()
                    os._exit(0)
                os._exit(1)
            assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    finally:
        os.kill(hostile, signal.SIGKILL)
        os.waitpid(hostile, 0)


OPENS = """
import sys
from pathlib import Path
from failover.boards import directory
from failover.boards.board import Board
from failover.errors import BoardError
make = directory._made
def made(*of):
    print("made a board in the agent's place", flush=True)
    return make(*of)
directory._made = made
print("begins", flush=True)
while True:
    try:
        with Board(Path(sys.argv[1]), "test") as board:
            board.item("ball")
    except BoardError:
        pass
"""


@needs_root
def test_no_program_makes_a_board_of_its_own_while_the_agent_makes_its_one_anew(folder: Path, found: None) -> None:
    """A program of the agent's user could: the directory is its user's."""
    place = board_directory.provide(loaded(folder, OWNED))
    assert place is not None
    with subprocess.Popen([sys.executable, "-c", OPENS, place], stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None and program.stdout.readline() == "begins\n"
        names = {path.name for path in place.iterdir()}
        for size in range(9, 29):
            board_directory.provide(loaded(folder, OWNED.replace("size = 8", f"size = {size}")))
            assert {path.name for path in place.iterdir()} == names
        program.kill()
        assert program.stdout.read() == ""


@needs_root
def test_a_file_of_a_user_that_cannot_be_made_costs_no_other_item(
    folder: Path, found: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    give = directory.give_to

    def full(file: int | Path, user: int, mode: int) -> None:
        if user == UID:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        give(file, user, mode)

    told: list[str] = []
    with monkeypatch.context() as patch:
        patch.setattr(directory, "give_to", full)
        place = board_directory.provide(loaded(folder, OWNED), told.append)
    assert place is not None
    assert len(told) == 1 and "No space left on device): no program here can put map, secret; free /dev/shm" in told[0]
    as_user(OTHER, lambda: put(place, "plan", b"p"))
    assert board_directory.provide(loaded(folder)) == place
    as_user(UID, lambda: put(place, "map", {"n": 7}))


def test_a_look_up_of_a_user_that_fails_for_a_while_costs_no_value_and_no_right(
    folder: Path, found: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    me = pwd.getpwuid(os.geteuid()).pw_name
    place = board_directory.provide(loaded(folder, BALL + f'[board.items.map]\nsize = 8\nuser = "{me}"\n'))
    assert place is not None
    put(place, "map", b"v")
    told: list[str] = []
    with monkeypatch.context() as patch:
        patch.setattr(board_directory, "uid_named", lambda _: board_directory.NOBODY)
        board_directory.provide(loaded(folder), told.append)
    assert len(told) == 1
    assert told[0].startswith(f"robot1 finds no user '{me}' now, and had one: uid {os.geteuid()} may still put map; see getent")
    with Board(place, "test") as board:
        assert board.item("map").get().value == b"v"
        board.item("map").put(b"w")


@needs_root
def test_the_next_agent_adopts_the_files_and_a_changed_declaration_makes_them_anew(folder: Path, place: Path) -> None:
    before = {path.name: path.stat().st_ino for path in boards_of(place)}
    with Board(place, "test") as board:
        reader = board.item("map")
        as_user(UID, lambda: put(place, "map", {"n": 7}))
        board_directory.provide(loaded(folder))
        assert {path.name: path.stat().st_ino for path in boards_of(place)} == before
        assert reader.get().value == {"n": 7}
        board_directory.provide(loaded(folder, OWNED.replace(f'"{PLANNER}"', f'"{MAPPER}"')))
        assert f"own+{OTHER}" not in {path.name for path in boards_of(place)}
        as_user(OTHER, lambda: _equal(f"user '{MAPPER}'" in refused(place, "plan", b"p"), True))
        as_user(UID, lambda: put(place, "plan", b"q"))
        as_user(UID, lambda: put(place, "map", {"n": 9}))
        assert (reader.get().value, board.item("plan").get().value) == ({"n": 9}, b"q")
        board_directory.provide(loaded(folder, BALL))
        assert not list(place.glob("own+*")) and AgentsFile(place).owners() is None


def test_a_user_who_is_not_on_this_robot_is_told_and_no_program_can_put_the_item(folder: Path, found: None) -> None:
    told: list[str] = []
    text = BALL + '[board.items.map]\nsize = 8\nuser = "no-such-user"\n[board.items.way]\nsize = 8\nuser = "no-such-user"\n'
    place = board_directory.provide(loaded(folder, text), told.append)
    assert place is not None
    assert told == ["robot1 has no user 'no-such-user': no program here can put map, way; make the user, and restart the agent"]
    assert AgentsFile(place).owners() == {"map": Owner(2, "no-such-user", None), "way": Owner(3, "no-such-user", None)}
    with failover.board() as board:
        assert sorted(board.names()) == ["ball", "notes"]
        item = board.item("map")  # that of the other robots
        with pytest.raises(failover.BoardError, match="for user 'no-such-user' alone; no program of robot1 can put it"):
            item.put(b"a")
        with pytest.raises(failover.NeverWrittenError):
            item.get("robot2")


def test_a_user_who_is_made_later_has_the_item_after_the_next_start_and_programs_go_on(
    folder: Path, found: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    me = pwd.getpwuid(os.geteuid()).pw_name
    text = BALL + f'[board.items.map]\nsize = 8\nuser = "{me}"\n'
    with monkeypatch.context() as patch:
        patch.setattr(board_directory, "uid_named", lambda _: board_directory.NOBODY)
        board_directory.provide(loaded(folder, text))
    with failover.board() as board:
        ball, item = board.item("ball"), board.item("map")
        ball.put({"x": 1.0, "y": 2.0})
        with pytest.raises(failover.BoardError, match="failover status says why"):
            item.put(b"a")
        board_directory.provide(loaded(folder))
        assert sorted(board.names()) == ["ball", "map", "notes"]
        item.put(b"b")
        assert board.snapshot()["robot1"]["map"].value == b"b"
        assert (item.get().value, ball.get().number) == (b"b", 1)
        monkeypatch.setattr(board_directory, "uid_named", lambda _: 7001)  # and then another number
        board_directory.provide(loaded(folder))
        assert item.source().file.path.name == "own+7001"
        assert sorted(board.names()) == ["ball", "map", "notes"]


def test_where_numbers_of_users_change_each_item_goes_to_the_file_of_its_user(
    folder: Path, found: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = BALL + '[board.items.map]\nsize = 8\nuser = "mapper"\n[board.items.way]\nsize = 8\nuser = "planner"\n'
    monkeypatch.setattr(board_directory, "uid_named", {"mapper": 7001, "planner": 7002}.get)
    place = board_directory.provide(loaded(folder, text))
    assert place is not None
    with Board(place, "test") as board:
        way = board.item("way")
        assert (board.item("map").source().file.path.name, way.source().file.path.name) == ("own+7001", "own+7002")
        monkeypatch.setattr(board_directory, "uid_named", {"mapper": 7002, "planner": 7001}.get)
        board_directory.provide(loaded(folder))
        assert (board.item("map").source().file.path.name, way.source().file.path.name) == ("own+7002", "own+7001")
        monkeypatch.setattr(board_directory, "uid_named", {"mapper": 7001, "planner": 7001}.get)
        board_directory.provide(loaded(folder))
        assert {path.name for path in place.glob("own+*")} == {"own+7001"}
        assert {board.item("map").source().file.path.name, way.source().file.path.name} == {"own+7001"}


def test_where_the_kernel_has_no_access_control_lists_that_is_told_and_the_rest_of_the_board_works(
    folder: Path, found: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none(*_: object) -> None:
        raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))

    me = pwd.getpwuid(os.geteuid()).pw_name
    told: list[str] = []
    with monkeypatch.context() as patch:
        patch.setattr(os, "setxattr", none)
        place = board_directory.provide(loaded(folder, BALL + f'[board.items.map]\nsize = 8\nuser = "{me}"\n'), told.append)
    assert place is not None and not list(place.glob("own+*"))
    assert len(told) == 1 and f"takes no access control list with uid {os.geteuid()} (Operation not supp" in told[0]
    assert "no program here can put map; use a kernel" in told[0]
    with failover.board() as board:
        board.item("ball").put({"x": 1.0, "y": 2.0})
        with pytest.raises(failover.BoardError, match="failover status says why"):
            board.item("map").put(b"a")


def test_in_a_user_namespace_without_that_user_too(folder: Path, found: None) -> None:
    space = ("unshare", "--user", "--map-root-user")
    if subprocess.run([*space, "true"], check=False, capture_output=True).returncode:
        pytest.skip("this system forbids user namespaces")
    loaded(folder, BALL + f'[board.items.map]\nsize = 8\nuser = "{MAPPER}"\n')
    provide = PROVIDE.replace("assert", "#")
    ran = subprocess.run(
        [*space, sys.executable, "-c", provide, folder / "agent.toml"], capture_output=True, text=True, check=False
    )
    assert f"takes no access control list with uid {UID} (Invalid argument): no program here can put map;" in ran.stdout, ran
    with failover.board() as board:
        board.item("ball").put({"x": 1.0, "y": 2.0})


def test_a_board_without_such_items_has_the_files_that_it_had(folder: Path, found: None) -> None:
    place = board_directory.provide(loaded(folder, BALL))
    assert place is not None
    assert sorted(path.name for path in boards_of(place)) == ["agent", "own", "peer-robot2", "private"]
    assert [record.name for record in MappedFile.open(place / directory.AGENT_NAME).records()] == ["primaries"]


def test_a_program_adds_no_item_of_one_user_which_the_team_file_does_not_declare(folder: Path, found: None) -> None:
    me = pwd.getpwuid(os.geteuid()).pw_name
    board_directory.provide(loaded(folder, BALL + f'[board.items.map]\nsize = 8\nuser = "{me}"\n'))
    with failover.board() as board:
        board.add(Item("map", size=8)).put(b"a")  # declared alike already
        board.add(Item("map", size=8, user=me)).put(b"b")
        assert board.item("map").get().number == 2
        with pytest.raises(failover.BoardError, match=f"team.toml declares it otherwise, for user '{me}' alone"):
            board.add(Item("map", size=8, user="nobody"))
        with pytest.raises(failover.BoardError, match=f"team.toml declares it otherwise, for user '{me}' alone"):
            board.add(Item("map", size=16))
        with pytest.raises(failover.BoardError, match=r"an item of one user is declared in team\.toml"):
            board.add(Item("way", size=8, user=me))
        assert "way" not in board.names()


def test_without_an_agent_a_program_adds_items_of_its_own_user_and_of_no_other(tmp_path: Path) -> None:
    me = pwd.getpwuid(os.geteuid()).pw_name
    with Board(tmp_path / "board", "test") as board:
        board.add(Item("map", size=8, user=me)).put(b"a")
        assert board.item("map").get().value == b"a"
        for user in ("nobody", "no-such-user"):
            with pytest.raises(failover.BoardError, match=f"for user '{user}' alone: .*here uid {os.geteuid()}"):
                board.add(Item("way", size=8, user=user))
