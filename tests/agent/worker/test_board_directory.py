"""The agent's board: made as the team file declares it, adopted by the next agent, made anew when the declarations change."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest

import failover
from agent import config as configuration
from agent.worker import board_directory, kept_items, schedule_place
from agent.worker.kept_items import Keeper
from failover.boards import SCHEDULE_PLACE
from failover.boards.mapping import MappedFile
from failover.boards.schedule_file import ScheduleFile
from failover.config import team
from failover.config.team import Robot, Team
from failover.core.board import layout
from failover.core.board.items import Item

BALL = """
[board.items.ball]
type = { x = "f4", y = "f4" }
[board.items.notes]
type = "msgpack"
size = 100
shared = false
"""


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """robot1's configuration, in a team of two robots and a witness that no other test has."""
    members = {
        "robot2": Robot(("127.0.0.1:7440",), "127.0.0.1:7441"),
        "robot1": Robot(("127.0.0.1:7420",), "127.0.0.1:7421"),
        "gate": Robot(("127.0.0.1:7430",), "127.0.0.1:7431", "witness"),
    }
    team.write(tmp_path / "team", Team(f"lab{uuid.uuid4().hex}", members))
    for part in ("state", "runtime"):
        (tmp_path / part).mkdir()
    places = "".join(f'{part}_directory = "{tmp_path / part}"\n' for part in ("team", "state", "runtime"))
    (tmp_path / "agent.toml").write_text(f'robot = "robot1"\ninsecure = true\n{places}')
    place = board_directory.place_of(loaded(tmp_path))
    yield tmp_path
    shutil.rmtree(place, ignore_errors=True)


def loaded(folder: Path, board: str | None = None) -> configuration.Settings:
    """The settings, with this board declared; None: as it was."""
    path = folder / "team" / team.TEAM_FILE
    if board is not None:
        path.write_text(path.read_text().partition("\n[board")[0] + "\n" + board)
    return configuration.load(folder / "agent.toml")


@pytest.fixture
def found(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Programs find this agent's runtime directory, and so its board."""
    monkeypatch.delenv("FAILOVER_BOARD", raising=False)
    monkeypatch.setenv("FAILOVER_SOCKET", str(folder / "runtime" / "control.sock"))


def boards_of(place: Path) -> list[Path]:
    """The files of a board, without the schedule beside them."""
    return [path for path in place.iterdir() if path.name != "schedule"]


def test_a_team_without_a_board_has_no_directory(folder: Path) -> None:
    settings = loaded(folder)
    assert board_directory.provide(settings) is None
    assert not board_directory.place_of(settings).exists()


@pytest.mark.usefixtures("found")
def test_the_declared_items_lie_in_the_files_of_their_robots(folder: Path) -> None:
    place = board_directory.provide(loaded(folder, BALL))
    assert place is not None
    modes = {path.name: oct(path.stat().st_mode & 0o777) for path in place.iterdir()}
    of_agent = {"agent": "0o640", "peer-robot2": "0o640"}
    assert modes == {"own": "0o660", "private": "0o660", "schedule": "0o660", **of_agent}
    names = {path.name: [record.name for record in MappedFile.open(path).records()] for path in boards_of(place)}
    assert names == {"own": ["ball"], "private": ["notes"], "peer-robot2": ["ball"], "agent": ["primaries"]}
    with failover.board() as board:
        assert (board.robot, board.directory) == ("robot1", place)
        board.item("ball").put({"x": 1.0, "y": 2.0})
        board.item("notes").put(["a"])
        assert {name: (robot.state, robot.rank) for name, robot in board.robots().items()} == {
            "robot1": ("run", 1),  # the witness has rank 0: ranks are those of the roster
            "robot2": ("not", 2),
        }
        with pytest.raises(failover.NeverWrittenError):
            board.item("ball").get("robot2")
    assert (place / "own").exists()  # it is the agent's, not its users'


@pytest.mark.usefixtures("found")
def test_the_next_agent_takes_the_board_over_and_its_users_notice_nothing(folder: Path) -> None:
    board_directory.provide(loaded(folder, BALL))
    with failover.board() as board:
        item = board.item("ball")
        item.put({"x": 1.0, "y": 2.0})
        board.add(Item("later", size=8)).put(b"x")
        generation = board.ensured().own.generation
        board_directory.provide(loaded(folder))
        assert board.ensured().own.generation == generation
        assert item.get().number == 1
        assert board.item("later").get().value == b"x"


@pytest.mark.usefixtures("found")
def test_other_declarations_make_the_board_anew_and_its_users_go_there(folder: Path) -> None:
    board_directory.provide(loaded(folder, BALL))
    with failover.board() as board:
        item = board.item("ball")
        item.put({"x": 1.0, "y": 2.0})
        board_directory.provide(loaded(folder, BALL + '[board.items.goal]\ntype = "bytes"\nsize = 4\n'))
        with pytest.raises(failover.NeverWrittenError):
            item.get()
        item.put({"x": 3.0, "y": 4.0})
        assert item.get().value == {"x": 3.0, "y": 4.0}
        board.item("goal").put(b"x")
        assert len(board.users()) == 1


def test_a_robot_that_left_the_team_leaves_the_board(folder: Path) -> None:
    settings = loaded(folder, BALL)
    place = board_directory.provide(settings)
    assert place is not None
    directory = folder / "team"
    members = {"robot1": settings.team.robots["robot1"], "robot3": settings.team.robots["robot2"]}
    team.write(directory, Team(settings.team.team, members, settings.team.board))
    board_directory.provide(loaded(folder))
    assert {path.name for path in place.iterdir()} == {"agent", "own", "private", "schedule", "peer-robot3"}


def test_a_file_that_is_damaged_is_made_anew(folder: Path) -> None:
    settings = loaded(folder, BALL)
    place = board_directory.provide(settings)
    assert place is not None
    for name, content in (("own", b"garbage" * 5000), ("private", b""), ("schedule", b"x"), ("peer-robot2", bytes(40000))):
        (place / name).write_bytes(content)
    board_directory.provide(settings)
    assert all(MappedFile.open(path).header.flags in layout.AREAS for path in boards_of(place))
    assert ScheduleFile.open(place / "schedule").rows() == {}


@pytest.mark.usefixtures("found")
def test_tasks_go_on_over_the_end_of_an_agent_and_the_start_of_the_next(folder: Path) -> None:
    board_directory.provide(loaded(folder, BALL))
    with failover.scheduled("mapper", period=0.005) as task:
        first = task.wait_activation()
        board_directory.provide(loaded(folder))
        second = task.wait_activation()
        assert first is not None and second is not None and second.number > first.number
        assert task.live.counts.started == 2


@pytest.mark.usefixtures("found")
def test_tasks_follow_their_schedule_to_a_board_that_is_declared_and_back(folder: Path) -> None:
    runtime = folder / "runtime"
    schedule_place.provide(runtime, "")
    with failover.scheduled("mapper", period=0.005) as task:
        task.wait_activation()
        assert (runtime / SCHEDULE_PLACE / "schedule").exists()
        place = board_directory.provide(loaded(folder, BALL))
        assert place is not None
        task.wait_activation()
        assert not (runtime / SCHEDULE_PLACE).exists()
        assert [row.name for row in ScheduleFile.open(place / "schedule").rows().values()] == ["mapper"]
        board_directory.provide(loaded(folder, ""))
        schedule_place.provide(runtime, "")
        task.wait_activation()
        assert [row.name for row in ScheduleFile.open(runtime / SCHEDULE_PLACE / "schedule").rows().values()] == ["mapper"]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a directory to another user")
def test_another_users_directory_is_refused(folder: Path) -> None:
    settings = loaded(folder, BALL)
    place = board_directory.place_of(settings)
    place.mkdir()
    os.chown(place, 12345, -1)
    with pytest.raises(Exception, match="belongs to uid 12345"):
        board_directory.provide(settings)


def test_a_group_that_does_not_exist_is_named(folder: Path) -> None:
    settings = loaded(folder, '[board]\ngroup = "no-such-group"\n' + BALL)
    with pytest.raises(Exception, match="no such group"):
        board_directory.provide(settings)


@pytest.mark.skipif(os.geteuid() != 0, reason="needs two users and a group")
def test_members_of_the_group_use_it_and_others_do_not(folder: Path) -> None:
    import grp

    group = grp.getgrnam("games")
    place = board_directory.provide(loaded(folder, '[board]\ngroup = "games"\n' + BALL))
    assert place is not None

    def tried(groups: list[int]) -> int:
        pid = os.fork()
        if pid == 0:
            os.setgroups(groups)
            os.setgid(65534)
            os.setuid(65534)
            try:
                with failover.board(place) as board:
                    board.item("ball").put({"x": 1.0, "y": 2.0})
                    os._exit(0 if not os.access(place / "peer-robot2", os.W_OK) else 3)
            except failover.BoardError:
                os._exit(1)
            finally:
                os._exit(2)
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])

    assert tried([group.gr_gid]) == 0
    assert tried([]) == 1


def reboot(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel has another boot id, and its shared memory is empty."""
    shutil.rmtree(place)
    monkeypatch.setattr("failover.boards.boottime.boot_id", lambda: uuid.uuid4().bytes)


def test_items_added_with_keep_are_there_after_a_reboot_and_others_are_not(
    folder: Path, found: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = loaded(folder, BALL)
    place = board_directory.provide(settings)
    assert place is not None
    keeper = Keeper(place, folder / "state")
    with failover.board() as board:
        board.add(Item("goal", {"x": "f4"}, period=3, bound_ms=2.5, keep=True)).put({"x": 1.0})
        board.add(Item("passing", size=8))
        board.add(Item("diary", size=9000, shared=False, keep=True, banks=3))
        keeper.look()
        before = {record.name: record for record in MappedFile.open(place / "own").records()}["goal"]
    assert kept_items.read(folder / "state") == (
        Item("goal", {"x": "f4"}, period=3, bound_ms=2.5, keep=True),
        Item("diary", size=9000, shared=False, keep=True, banks=3),
    )
    reboot(place, monkeypatch)
    board_directory.provide(settings)
    with failover.board() as board:
        assert board.names() == ["ball", "goal", "notes", "diary"]
        with pytest.raises(failover.NeverWrittenError):
            board.item("goal").get()
        after = {record.name: record for record in MappedFile.open(place / "own").records()}["goal"]
        assert (after.id, after.flags, after.text) == (before.id, before.flags, before.text)
        Keeper(place, folder / "state").look()
        board.remove("goal")
        Keeper(place, folder / "state").look()
    assert [item.name for item in kept_items.read(folder / "state")] == ["diary"]
    reboot(place, monkeypatch)
    board_directory.provide(loaded(folder, BALL.replace("notes", "diary")))
    with failover.board() as board:
        assert board.names() == ["ball", "diary"]
        assert board.item("diary").source().record.size == 100


def test_a_list_of_kept_items_that_cannot_be_read_does_not_keep_the_board_away(folder: Path, found: None) -> None:
    settings = loaded(folder, BALL)
    for text in ("[board", "board = 1", "[board.items.x]\ntype = 'f9'\n", "[board.items.x]\nsizes = 1\n"):
        (folder / "state" / kept_items.FILE_NAME).write_text(text)
        assert kept_items.read(folder / "state") == ()
    large = tuple(Item(f"large{number}", size=60_000, shared=False, banks=8, keep=True) for number in range(34))
    kept_items.write(folder / "state", large)
    board_directory.provide(settings)
    with failover.board() as board:
        assert len(board.names()) == 2 + len(large)


def test_kept_items_that_find_no_room_stay_on_the_disk_and_the_others_are_added(
    folder: Path, found: None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    large = tuple(Item(f"large{number}", size=60_000, shared=False, banks=8, keep=True) for number in range(34))
    kept_items.write(folder / "state", large)
    place = board_directory.provide(loaded(folder, BALL.replace("size = 100", "size = 60000\nbanks = 8")))
    assert place is not None
    with failover.board() as board:
        added = set(board.names()) - {"ball", "notes"}
    assert added == {item.name for item in large[: len(added)]} and len(large) - len(added) == 1
    assert "large33" in caplog.text and "large32" not in caplog.text
    keeper = Keeper(place, folder / "state")
    keeper.look()
    assert kept_items.read(folder / "state") == large[:-1]
    (folder / "state" / kept_items.BEFORE_NAME).rename(folder / "state" / kept_items.FILE_NAME)
    assert kept_items.read(folder / "state") == large
    with failover.board() as board:
        board.remove("large0")
    keeper.look()
    assert not (folder / "state" / kept_items.BEFORE_NAME).exists(), "the agent has written the file itself since its start"


def test_a_list_of_kept_items_that_cannot_be_read_is_not_lost_when_it_is_written_anew(folder: Path, found: None) -> None:
    (folder / "state" / kept_items.FILE_NAME).write_text("[board")
    place = board_directory.provide(loaded(folder, BALL))
    assert place is not None
    with failover.board() as board:
        board.add(Item("goal", size=8, keep=True))
    Keeper(place, folder / "state").look()
    assert [item.name for item in kept_items.read(folder / "state")] == ["goal"]
    assert (folder / "state" / kept_items.BEFORE_NAME).read_text() == "[board"


def test_a_list_that_cannot_be_written_is_told_once(folder: Path, found: None, caplog: pytest.LogCaptureFixture) -> None:
    place = board_directory.provide(loaded(folder, BALL))
    assert place is not None
    with failover.board() as board:
        board.add(Item("goal", size=8, keep=True))
    keeper = Keeper(place, folder / "missing")
    for _ in range(3):
        keeper.look()
    assert caplog.text.count("are not written") == 1
    (folder / "missing").mkdir()
    keeper.look()
    assert [item.name for item in kept_items.read(folder / "missing")] == ["goal"]


def test_a_peers_file_that_is_full_of_removed_items_is_made_anew(folder: Path) -> None:
    settings = loaded(folder, BALL)
    place = board_directory.provide(settings)
    assert place is not None
    file = MappedFile.open(place / "peer-robot2", writable=True)
    with file.changing():
        for number in range(600):
            file.remove(file.add(layout.Wanted(9000 + number, f"x{number}", 8)))
    file.close()
    board_directory.provide(settings)
    assert file.is_gone
    assert [record.name for record in MappedFile.open(place / "peer-robot2").records()] == ["ball"]
