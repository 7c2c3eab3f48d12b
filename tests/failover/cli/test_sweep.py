"""Every verb with arguments it cannot use: a sentence and an exit status, as JSON one object, never anything else."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from failover.cli import main, parser

UNDER_AN_AGENT = {
    "run": ["--", "/bin/true"],
    "protect": ["1"],
    "release": ["x"],
    "start": ["x"],
    "stop": ["x"],
    "logs": ["x"],
    "status": [],
    "why": [],
    "handover": ["x"],
    "failback": ["x"],
    "prefer": ["x", "y"],
    "promote": ["x"],
    "drill": ["x"],
    "drain": ["x"],
    "undrain": ["x"],
    "reserve": ["x", "--for", "10min", "--why", "y"],
    "unreserve": ["x"],
}
FILES = ("missing", "directory", "empty", "junk", "sparse", "/dev/null", "/dev/zero", "/proc/self/mem", "x" * 300, "locked")
NO_PIDS = ("0", "-1", "me", "99999999999999999999")
TEAMS = (
    *(["show"], ["list"], ["invite", "r"], ["join", "junk"], ["enrol", "a/b", "h"], ["enrol", "r", "h:99999"]),
    *(["create", "x", "--directory", "/proc/1/team"], ["create", "x", "--empty", "--directory", "/proc/1/team"]),
)
BOARDS = (
    [],
    ["get", "ball"],
    ["put", "ball", "1"],
    ["top"],
    ["users"],
    ["header"],
    ["import", "missing"],
    ["import", "junk"],
    ["record", "out.mcap"],
    ["serve", "--foxglove", "0"],
)
BRIDGES = ([], ["--listen", "tcp/0.0.0.0:7447"], ["--connect", "somewhere"])
TASKS = (
    *(["ps"], ["trace", "-o", "out", "--for", "1s"], ["task", "add", "x", "period_ms=9"], ["task", "set", "x", "period_ms=9"]),
    *(["task", "remove", "x"], ["task", "histogram", "x"], ["task", "import", "missing", "--tick-ms", "33"]),
)
RIGHTS = (["list"], ["why", "root", "see", "/x"])
PROGRAMS = (
    *(
        ["verify", "missing"],
        ["verify", "junk"],
        ["verify", "directory"],
        ["send", "sparse"],
        ["sign", "junk", "--key", "missing"],
    ),
    *(["pack", "missing", "-o", "out"], ["pack", "directory", "-o", "out"], ["key", "missing/a.key"], ["key", "junk"]),
    *(
        ["run", "engine"],
        ["run", "./directory"],
        ["log", "engine"],
        ["log", "../x"],
        ["switch", "engine", "2"],
        ["rollback", "engine"],
        ["send", "junk", "--to", "robot2"],
    ),
)
DRIVERS = (["names"], ["call", "engine", "read"], ["send", "engine", '{"verb": "read"}'], ["path", "x"], ["graph"])
SIMULATIONS = (
    *(["--world", file] for file in ("missing", "directory", "junk", "sparse", "empty", "missing/world.toml")),
    *(["--robots", "257"], ["--robots", "3", "--labs", "4"], ["--robots", "9", "--labs", "65"], ["--pace", "max"]),
    ["--world", "amur-7", "--robots", "2"],
    *(["--for", "1", "--board", at] for at in ("junk", "junk/board", "nowhere/board")),
)
PAGES = (
    *(
        ["--listen", address]
        for address in ("0.0.0.0:7480", "[::]:7480", "192.168.7.11:7480", "robot1:7480", "127.0.0.1", "127.0.0.1:x")
    ),
    *(["--config", file] for file in ("missing", "directory", "junk", "sparse")),
)
USAGE = (
    *(["bogus"], [], ["status", "--bogus"], ["status", "--every-ms", "x"], ["completion", "x"], ["team"]),
    ["stop", "x", "--signal", "?"],
    *(["team", "invite", "x", "--port", port] for port in ("-1", "65536", "x")),
    *(["board", "record", "x", *rest] for rest in (["--rate", "0"], ["--rate", "2000"], ["--for", "soon"], ["--max-size", "9"])),
    *(["board", "serve", "--foxglove", port] for port in ("-1", "65536", "x")),
    *(["bridge", *rest] for rest in ([], ["dds"], ["zenoh", "--rate", "0"])),
    *(["board", "replay", "x", "--pace", pace] for pace in ("0", "nan", "fast")),
    ["task", "run", "--signal", "BELL", "x", "period_ms=20", "--", "true"],
    *(["simulate", "--robots", count] for count in ("0", "-1", "many")),
    *(["simulate", *rest] for rest in (["--for", "0"], ["--for", "soon"], ["--pace", "0"], ["--pace", "nan"], ["--seed", "-1"])),
    *(["board", "fly"], ["board", "get"], ["board", "--every-ms", "0"], ["board", "import", "f", "--robot", "a"]),
    *(["check", pid] for pid in NO_PIDS),
    ["check", "1", "--table"],
    *(["protect", pid] for pid in NO_PIDS),
)


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "directory").mkdir()
    (tmp_path / "empty").touch()
    (tmp_path / "junk").write_bytes(os.urandom(9_000))
    (tmp_path / "locked").touch(mode=0)
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(1 << 40)


def told(capsys: pytest.CaptureFixture[str], *argv: str) -> int:
    """Run it twice, as text and as JSON; the exit status, the same of both."""
    statuses = []
    for asked in ([], ["--json"]):
        verb, rest = argv[:1], argv[1:]
        with_acts = verb in (("team",), ("board",), ("bridge",), ("task",), ("rights",), ("program",), ("lost",), ("archive",))
        statuses.append(main.main([*argv, *asked] if with_acts else [*verb, *asked, *rest]))
        said = capsys.readouterr()
        if asked:
            assert said.err == ""
            assert set(json.loads(said.out)) >= {"error", "message", "reasons"}
        else:
            assert said.out == ""
            assert said.err.startswith("failover: ")
            assert len(said.err.splitlines()[0]) > 20, "a sentence"
    assert statuses[0] == statuses[1]
    return statuses[0]


@pytest.mark.parametrize("at", ["nowhere", "junk", "directory"])
@pytest.mark.parametrize("verb", UNDER_AN_AGENT)
def test_without_an_agent(verb: str, at: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert told(capsys, verb, "--socket", at, *UNDER_AN_AGENT[verb]) == main.NO_AGENT


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("verb", ["restore", "inspect"])
def test_with_a_file_that_is_no_snapshot(verb: str, file: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert told(capsys, verb, file) == main.FAILED


def test_with_a_process_that_cannot_be_captured(capsys: pytest.CaptureFixture[str]) -> None:
    zombie = os.posix_spawn("/bin/true", ["true"], {})
    os.waitid(os.P_PID, zombie, os.WEXITED | os.WNOWAIT)
    for pid in (str(zombie), "2147483647"):
        assert told(capsys, "capture", pid, "-o", "out") == main.FAILED
        assert not Path("out").exists()
    os.waitpid(zombie, 0)


@pytest.mark.parametrize("act", TEAMS, ids=" ".join)
def test_with_a_team_that_cannot_be(act: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    directory = [] if "--directory" in act else ["--directory", "directory"]
    assert told(capsys, "team", *act, *directory) == main.FAILED


@pytest.mark.parametrize("act", ["remove r", "rotate", "rotate r"])
def test_without_an_agent_no_member_leaves_and_no_key_changes(act: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert told(capsys, "team", *act.split(), "--socket", "nowhere") == main.NO_AGENT


@pytest.mark.parametrize("at", ["nowhere", "directory", "junk"])
@pytest.mark.parametrize("act", BOARDS, ids=" ".join)
def test_with_a_board_that_is_none(act: list[str], at: str, capsys: pytest.CaptureFixture[str]) -> None:
    where = {"header": ["--directory", at], "import": []}.get(act[0] if act else "", ["--board", at])
    assert told(capsys, "board", *act, *where) == main.FAILED
    assert sorted(Path("directory").iterdir()) == [] and not Path("out.mcap").exists()


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("act", [["replay"], ["record", "--recover"]], ids=" ".join)
def test_with_a_file_that_is_no_recording(act: list[str], file: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert told(capsys, "board", *act, file, "--board", "directory") == main.FAILED
    assert sorted(Path("directory").iterdir()) == []


@pytest.mark.parametrize("at", ["nowhere", "directory", "junk"])
@pytest.mark.parametrize("argv", TASKS, ids=" ".join)
def test_with_a_schedule_that_is_none(argv: list[str], at: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert told(capsys, *argv, "--board", at) == main.FAILED
    assert sorted(Path("directory").iterdir()) == [] and not Path("out").exists()


def test_with_a_program_that_no_task_runs(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("FAILOVER_ACTIVATION_FD", raising=False)
    assert told(capsys, "wait-activation") == main.FAILED


@pytest.mark.parametrize("at", ["directory", "junk", "missing/place"])
@pytest.mark.parametrize("act", DRIVERS, ids=" ".join)
def test_with_drivers_that_are_not_there(
    act: list[str], at: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FAILOVER_DRIVERS", at)
    assert told(capsys, *act) == main.FAILED
    assert sorted(Path("directory").iterdir()) == []


@pytest.mark.parametrize("act", PROGRAMS, ids=" ".join)
def test_with_programs_that_are_none(
    act: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("FAILOVER_DRIVERS", "directory")
    monkeypatch.setenv("FAILOVER_PROGRAMS", str(tmp_path / "programs"))
    assert told(capsys, "program", *act) == main.FAILED
    assert sorted(Path("directory").iterdir()) == [] and not Path("out").exists()


@pytest.mark.parametrize("content", ["junk", "sparse", "directory"])
@pytest.mark.parametrize("act", RIGHTS, ids=" ".join)
def test_with_rights_that_are_none(act: list[str], content: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("team").mkdir()
    Path(content).rename("team/rights.toml")
    assert told(capsys, "rights", *act, "--directory", "team") == main.FAILED


@pytest.mark.parametrize("options", PAGES, ids=" ".join)
def test_with_a_page_that_may_not_be_served(options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert told(capsys, "page", *options) == main.FAILED


@pytest.mark.parametrize("options", BRIDGES, ids=" ".join)
def test_with_a_bridge_that_leads_nowhere(options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert told(capsys, "bridge", "zenoh", "--board", "nowhere", *options) == main.FAILED


@pytest.mark.parametrize("options", SIMULATIONS, ids=" ".join)
def test_with_a_world_that_cannot_be(options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert told(capsys, "simulate", *options) == main.FAILED
    assert not Path("nowhere").exists()


@pytest.mark.parametrize("act", ["inspect", "restore", "remove"])
def test_with_copies_that_lost_and_are_not_there(act: str, capsys: pytest.CaptureFixture[str]) -> None:
    for at in ("nowhere", "directory", "junk"):
        assert told(capsys, "lost", act, "mapper", "--state", at) == main.FAILED


@pytest.mark.parametrize("act", ["list", "fetch"])
def test_with_an_archive_that_cannot_be_opened(act: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("team").mkdir()
    asked = [act, "mapper", *(["--output", "new"] if act == "fetch" else [])]
    places = (["--place", str(Path.cwd() / "nowhere")], ["--place", "here"], ["--place", "s3://"], ["--place", ""])
    for options in (*places, [*places[0], "--endpoint", "nowhere"]):
        assert told(capsys, "archive", *asked, *options, "--directory", "team") == main.FAILED
    Path("team/team.toml").write_text('team = "lab"\n')
    for content in (b"", b"junk", b"ab" * 32):
        Path("team/keys").mkdir(exist_ok=True)
        Path("team/keys/archive.key").write_bytes(content)
        Path("team/keys/archive.key").chmod(0o600)
        assert told(capsys, "archive", *asked, *places[0], "--directory", "team") == main.FAILED
    Path("team/keys/archive.public").write_text("of another key")
    assert told(capsys, "archive", "key", "--directory", "team") == main.FAILED
    assert not Path("new").exists() and not Path("nowhere").exists()


def test_the_full_screen_without_a_terminal_or_its_library(capsys: pytest.CaptureFixture[str]) -> None:
    assert told(capsys, "top") == main.FAILED


@pytest.mark.parametrize("argv", USAGE, ids=" ".join)
def test_with_a_command_line_that_is_none(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main.main(argv)
    assert ended.value.code == 2
    assert "error: " in capsys.readouterr().err


def test_the_sweep_leaves_no_verb_out() -> None:
    without = {"restore", "inspect", "capture", "check", "team", "board", "completion"}
    without |= {
        "page",
        "bridge",
        "simulate",
        "ps",
        "task",
        "trace",
        "wait-activation",
        "rights",
        "program",
        "lost",
        "archive",
        "top",
    }
    swept = {*UNDER_AN_AGENT, *without, *(act[0] for act in DRIVERS)}
    assert {verb.name for verb in parser.VERBS} - swept == {"demo"}
