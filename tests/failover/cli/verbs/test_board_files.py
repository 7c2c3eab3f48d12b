"""failover board header and import, with the real compiler."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from failover.cli import main
from failover.config import team
from failover.core.board.item_types import parse, size_of
from failover.core.board.items import Item

SAMPLES = Path(__file__).parents[3] / "samples"
ROBOTS = "".join(f'[robots.robot{n}]\nbeats = ["127.0.0.1:742{n}"]\nbulk = "127.0.0.1:743{n}"\n' for n in (1, 2))
BOARD = """
[board.items.ball]
type = { x = "f4", pose = { a = "f8", ok = "bool" }, v = "f4[2][3]", text = "char[5]", class = "u2", near = "{x:i1,y:i8}[2]" }
[board.items."cmd.vel"]
type = "f8[3]"
[board.items.plan]
type = "msgpack"
size = 512
[board.items.ROBOT_WS]
type = "bytes"
size = 408
shared = false
"""

HEADERS = {
    "World.h": "struct Point { double x, y; };\nclass WorldModel { public: Point at[7]; char side; float f() { return 1; } };\n",
    "CoachInfo.h": "#pragma once\ntypedef struct { int mode; char text[256]; } CoachInfo;\n",
}
CONF = """AGENTS = BASE, PLAYER_1;
ITEM WORLD { datatype = WorldModel; headerfile = World.h; period = 3; }
ITEM COACH_INFO { datatype = CoachInfo; }
ITEM CLOCK { datatype = int; headerfile = stdio.h; }
SCHEMA B { shared = COACH_INFO }
SCHEMA P { shared = WORLD; local = COACH_INFO }
ASSIGNMENT { schema = B; agents = BASE }
ASSIGNMENT { schema = P; agents = PLAYER_1 }
"""


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A directory with a team file, an rtdb.conf and headers."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "team.toml").write_text(f'team = "lab"\n{ROBOTS}{BOARD}')
    (tmp_path / "rtdb.conf").write_text(CONF)
    (tmp_path / "include").mkdir()
    for name, text in HEADERS.items():
        (tmp_path / "include" / name).write_text(text)
    return tmp_path


def said(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str, str]:
    """Exit status, standard output and standard error of one command line."""
    status = main.main(list(argv))
    out, err = capsys.readouterr()
    return status, out, err


@pytest.mark.compiler
@pytest.mark.parametrize("compiler", [["gcc", "-std=c11"], ["g++", "-std=c++11", "-x", "c++"]], ids=["C", "C++"])
def test_the_header_compiles_and_its_structs_lie_as_the_boards(
    place: Path, capsys: pytest.CaptureFixture[str], compiler: list[str]
) -> None:
    if shutil.which(compiler[0]) is None:
        pytest.skip(f"needs {compiler[0]}: apt-get install {compiler[0]}")
    status, out, _ = said(capsys, "board", "header", "--directory", ".", "--rtdb")
    assert status == 0
    kind = parse("{x:f4,pose:{a:f8,ok:bool},v:f4[2][3],text:char[5],class:u2,near:{x:i1,y:i8}[2]}")
    digest = Item("ball", kind).type_digest
    (place / "items.h").write_text(out)
    uses = f"""
    #include "items.h"
    #include "items.h"
    static Ball one; static CmdVel velocity;
    int main(void) {{
        static_assert(BALL_DIGEST == UINT64_C({digest}), "digest");
        one.class_ = 3; one.near[1].y = 4; one.v[1][2] = 5; velocity[2] = 6;
        return BALL_NUMBER == 0 && CMD_VEL_NUMBER == 1 && ROBOT_WS_SIZE == 408 && ROBOT_WS == 3 && robot2 == 1 && N_AGENTS == 2
            && ball == 0 && sizeof one == {size_of(kind)} && sizeof PLAN_ITEM == 5 ? 0 : 1;
    }}
    """
    (place / "uses.c").write_text(uses)
    subprocess.run([*compiler, "-Wall", "-Werror", "-o", "uses", "uses.c"], check=True)
    assert subprocess.run(["./uses"], check=False).returncode == 0


@pytest.mark.compiler
def test_a_header_for_another_layout_does_not_compile(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, out, _ = said(capsys, "board", "header", "--directory", ".")
    (place / "items.c").write_text(out.replace("uint16_t class_", "uint64_t class_", 1))
    ran = subprocess.run(["gcc", "-c", "-o", "items.o", "items.c"], capture_output=True, text=True, check=False)
    assert ran.returncode != 0
    assert "this processor lays structs out otherwise" in ran.stderr


def test_the_header_as_json_has_every_item(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = said(capsys, "board", "header", "--directory", ".", "--json")
    answer = json.loads(out)
    assert status == 0
    assert [(item["number"], item["name"], item["size"]) for item in answer["items"]][2:] == [
        (2, "plan", 512),
        (3, "ROBOT_WS", 408),
    ]
    assert answer["digest"] == f"{team.read(place).items().digest:016x}"


def test_the_digest_by_which_robots_compare_their_boards_is_told(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    digest = f"{team.read(place).items().digest:016x}"
    assert main.main(["team", "show", "--directory", "."]) == 0
    assert f"board: 4 items, digest {digest}: it must be the same on every member" in capsys.readouterr().out
    assert main.main(["team", "show", "--directory", ".", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["board"] == {"items": ["ball", "cmd.vel", "plan", "ROBOT_WS"], "digest": digest}


def test_two_items_of_one_name_in_c_are_told(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (place / "team.toml").write_text('team = "lab"\n[board.items."a.b"]\nsize = 4\n[board.items.A_B]\nsize = 4\n')
    status, _, err = said(capsys, "board", "header", "--directory", ".")
    assert (status, err) == (1, "failover: items 'a.b' and 'A_B' are both A_B in C; rename one\n")


@pytest.mark.compiler
@pytest.mark.command("g++")
def test_an_rtdb_conf_becomes_a_board_with_the_sizes_of_its_types(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = said(capsys, "board", "import", "rtdb.conf", "-I", "include", "--robot", "PLAYER_1=robot1")
    assert status == 0
    assert "note: rtdb.conf:4: item CLOCK is in no schema: no agent has it" in err
    (place / "team.toml").write_text(f'team = "lab"\n{ROBOTS}{out}')
    items = team.read(place).items().items
    assert [(item.name, item.size, item.period) for item in items] == [("WORLD", 120, 3), ("COACH_INFO", 260, 1), ("CLOCK", 4, 1)]
    assert items[1].robots == ("BASE", "robot1")
    assert items[1].is_shared_by("BASE") and not items[1].is_shared_by("robot1")
    assert "[board.items.WORLD]  # WorldModel of World.h" in out


@pytest.mark.compiler
@pytest.mark.command("g++")
def test_a_header_that_is_not_found_is_told_with_the_line_of_its_item(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = said(capsys, "board", "import", "rtdb.conf")
    assert (status, out) == (1, "")
    assert "give the folders of the headers with -I DIR" in err
    assert "rtdb.conf:2:10: fatal error: World.h: No such file or directory" in err
    (place / "rtdb.conf").write_text(CONF.replace("= WorldModel", "= WorldModle"))
    status, _, err = said(capsys, "board", "import", "rtdb.conf", "-I", "include")
    assert status == 1
    assert "rtdb.conf:2:" in err and "'WorldModle' was not declared" in err


@pytest.mark.compiler
@pytest.mark.command("g++")
def test_an_item_that_no_agent_has_needs_no_header_and_keeps_its_number(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (place / "rtdb.conf").write_text(CONF.replace("int; headerfile = stdio.h", "Lost; headerfile = lost.h"))
    status, out, err = said(capsys, "board", "import", "rtdb.conf", "-I", "include")
    assert status == 0
    assert "the type of CLOCK is not found; no agent has it, so it keeps its number, with 1 byte" in err
    assert out.endswith('[board.items.CLOCK]  # Lost of lost.h\ntype = "bytes"\nsize = 1\nshared = false\nrobots = []\n')


@pytest.mark.compiler
@pytest.mark.command("g++")
def test_nothing_of_a_header_is_run(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (place / "include" / "World.h").write_text(
        '#include <stdio.h>\nstatic int at = fclose(fopen("ran", "w"));\nstruct WorldModel { char a[sizeof(at)]; };\n'
    )
    assert said(capsys, "board", "import", "rtdb.conf", "-I", "include")[0] == 0
    assert not (place / "ran").exists()


def test_a_machine_without_a_compiler_is_told_which_package_it_lacks(
    place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(place))
    monkeypatch.delenv("CXX", raising=False)
    status, _, err = said(capsys, "board", "import", "rtdb.conf")
    assert status == 1
    assert "there is none of g++, c++, clang++; install one with: apt-get install g++ (a compiler), binutils (nm)" in err
    _, _, err = said(capsys, "board", "import", "rtdb.conf", "--cc", "arm-g++ -O2")
    assert "there is no command arm-g++" in err


def test_a_mistake_in_an_rtdb_conf_is_told_with_line_and_column(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (place / "rtdb.conf").write_text(CONF.replace("World.h", "World.hpp"))
    status, _, err = said(capsys, "board", "import", "rtdb.conf")
    assert status == 1
    assert 'rtdb.conf:2:50: item WORLD: "headerfile" names a file NAME.h, not "World.hpp"' in err


def test_an_xml_becomes_a_board_without_a_compiler(
    place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "")
    (place / "a.xml").write_text('<RtDB2Configuration>\n<key id="A" period="5"/>\n</RtDB2Configuration>')
    status, out, _ = said(capsys, "board", "import", "a.xml", "--size", "200")
    assert status == 0
    assert out == '[board]\n\n[board.items.A]\ntype = "msgpack"\nsize = 200\nperiod = 5\n'


@pytest.mark.parametrize("file", ["missing", ".", "junk"])
def test_a_file_that_is_none_is_a_sentence(place: Path, file: str, capsys: pytest.CaptureFixture[str]) -> None:
    (place / "junk").write_bytes(b"\xff\0\x80" * 400)
    for asked in ([], ["--json"]):
        status, out, err = said(capsys, "board", "import", file, *asked)
        assert status == 1
        assert (json.loads(out)["error"] if asked else err[:10]) in ("FileMistakeError", "failover: ")


@pytest.mark.compiler
@pytest.mark.command("g++")
def test_the_file_of_a_whole_team_is_imported(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from failover.core.board import rtdb_conf

    found = rtdb_conf.parse((SAMPLES / "rtdb.conf").read_bytes(), "rtdb.conf")
    for item in found.items:
        if item.headerfile != "stdio.h":
            path = place / "include" / item.headerfile
            before = path.read_text() if path.exists() and item.headerfile not in HEADERS else "#pragma once\n"
            guard = f"#ifndef {item.datatype}_\n#define {item.datatype}_\nstruct {item.datatype} {{ double v[3]; }};\n#endif\n"
            path.write_text(before + guard)
    (place / "include" / "CoachInfo.h").write_text(
        "#pragma once\nstruct CoachInfo { int a; };\nstruct Formation { char a[88]; };\n"
    )
    status, out, _ = said(capsys, "board", "import", str(SAMPLES / "rtdb.conf"), "-I", "include", "--json")
    answer = json.loads(out)
    assert status == 0
    assert len(answer["items"]) == 21
    assert answer["items"][5] | {"size": 88, "type": "bytes[88]"} == answer["items"][5]
