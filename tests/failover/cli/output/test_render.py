"""Tables on terminals of every width: no word is cut, columns stand below each other, and one cause is told once."""

from __future__ import annotations

import re
from typing import Any

import pytest

from failover.cli.output import render, team_tree
from tests.failover.cli.test_verbs import COMPONENT, PEER, STATUS

ESCAPE = re.compile(r"\x1b\[[0-9;]*m")
FRAME = str.maketrans(dict.fromkeys("│╭╮╰╯├┤┬┴┼─└", " "))
STATES = (
    {"protection": "none"},
    {"protection": "protected", "engine": "cooperative", "freeze_us": 0, "commit_age_ms": 14_210.0, "commit_overdue": True},
    {"state": "degraded", "freeze_us": 1_092_230, "freeze_us_max": 1_092_230, "lag_ms": 18_800.0},
    {"state": "ended", "exit_status": 3 << 8, "standby": None},
)
NAMES = {
    "short": "/lab/r1/map{}",
    "long": "/lab/robot1/navigation/mapper-of-the-northern-warehouse-hall-{}",
    "wide": "/lab/ロボット/地図作成プログラム{}",
}


def team(name: str) -> dict[str, Any]:
    """A status with a component in each state that has a long word."""
    components = [COMPONENT | state | {"name": name.format(number)} for number, state in enumerate(STATES)]
    return STATUS | {"components": components, "peers": [PEER | {"lane": "connected", "beats_lost": 13}]}


def on_terminal(width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], draw: Any) -> list[str]:
    """The lines that are drawn on a terminal of so many columns."""
    monkeypatch.setattr(render, "is_terminal", lambda: True)
    monkeypatch.setenv("COLUMNS", str(width))
    capsys.readouterr()
    draw()
    return ESCAPE.sub("", capsys.readouterr().out).splitlines()


@pytest.mark.parametrize("width", [60, 72, 80, 90, 100, 110, 120, 132, 150, 170, 200])
@pytest.mark.parametrize("name", NAMES.values(), ids=NAMES)
def test_a_status_loses_no_word_on_any_terminal(
    name: str, width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    status = team(name)
    lines = on_terminal(width, monkeypatch, capsys, lambda: render.tree(status))
    assert max(map(render.width_of, lines)) <= width
    assert "…" not in "".join(lines)
    words = " ".join(lines).translate(FRAME).split()
    for row in team_tree.rows(status):
        for cell in row.cells[1:]:
            assert all(word in words or f"{word}," in words for word in cell.split() if word.strip("–")), (cell, lines)
    whole = "".join("".join(lines).translate(FRAME).split())
    assert all("".join(row.cells[0].translate(FRAME).split()) in whole for row in team_tree.rows(status))


@pytest.mark.parametrize("is_terminal", [True, False])
def test_what_a_program_said_gives_the_terminal_no_orders(
    is_terminal: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    said = "it ended: \x1b]0;mine\x07 \x9b2J \N{RIGHT-TO-LEFT OVERRIDE}"
    status = STATUS | {"components": [COMPONENT | {"notes": [said]}], "peers": []}
    monkeypatch.setattr(render, "is_terminal", lambda: is_terminal)
    monkeypatch.setenv("COLUMNS", "200")
    render.tree(status)
    shown = ESCAPE.sub("", capsys.readouterr().out)
    assert all(one in shown for one in ("it ended: ", r"\x1b]0;mine\x07", r"\x9b2J", r"\u202e"))
    assert not set(shown) & set("\x1b\x07\x9b\N{RIGHT-TO-LEFT OVERRIDE}")


@pytest.mark.parametrize("width", [60, 80, 100, 200])
def test_a_key_is_shown_whole_on_any_terminal(
    width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    key = "!y^qs8ev/gW)jw108MlPqpeemsP^RpOyp=GivYm="
    row = ("robot1", "robot", "192.168.7.11:7420 10.0.0.11:7420", "192.168.7.11:7421", key)
    columns = ("robot", "role", "beats", "bulk", "public key")
    assert key in "\n".join(on_terminal(width, monkeypatch, capsys, lambda: render.table(columns, [row])))


def test_columns_stand_below_each_other_whichever_script_a_name_is_in() -> None:
    table = render.plain_table(("", "state"), [("/lab/地図", "running"), ("/lab/map", "running"), ("/lab/e\u0301", "running")])
    starts = {render.width_of(line[: line.index("running")]) for line in table.splitlines()[1:]}
    assert len(starts) == 1


def with_notes(*notes: str, names: tuple[str, ...] = ("/lab/a", "/lab/b", "/lab/c"), **fields: Any) -> dict[str, Any]:
    """Components of which each has these notes, with its own number in them."""
    told = [[note.format(number=number, name=name) for note in notes] for number, name in enumerate(names)]
    components = [COMPONENT | fields | {"name": name, "notes": one} for name, one in zip(names, told, strict=True)]
    return STATUS | {"components": components}


def test_one_cause_is_told_once_with_the_components_that_it_concerns() -> None:
    status = with_notes(
        "snapshots do not arrive: No space left on device; the last checkpoint is {number}.5 s old",
        "the guard of {name} ended",
        "pid 4{number} did not run for 1 s",
    )
    for component in status["components"]:
        full = "a snapshot was not stored at robot2: No space left on device"
        component["elsewhere"] = {"robot2": component | {"role": "standby", "notes": [full]}}
    assert team_tree.remarks(status) == (
        "/lab/a, /lab/b and /lab/c: snapshots do not arrive: No space left on device; the last checkpoint is 0.5–2.5 s old "
        "(a snapshot was not stored at robot2)",
        "/lab/a, /lab/b and /lab/c: the guard of it ended",
        "/lab/a, /lab/b and /lab/c: pid 40, 41 and 42 did not run for 1 s",
    )


def test_another_cause_stays_another_note() -> None:
    status = with_notes("not captured: fd {number} is a socket", names=("/lab/a", "/lab/b"))
    assert team_tree.remarks(status) == (
        "/lab/a: not captured: fd 0 is a socket",
        "/lab/b: not captured: fd 1 is a socket",
    )


def test_a_robot_that_a_note_names_is_not_put_before_it() -> None:
    component = COMPONENT | {"elsewhere": {"robot2": COMPONENT | {"notes": ["robot2 could not resume it: no lidar", "no luck"]}}}
    assert team_tree.remarks(STATUS | {"components": [component]}) == (
        "/lab/robot1/mapper: robot2 could not resume it: no lidar",
        "/lab/robot1/mapper: robot2: no luck",
    )


def test_a_ready_copy_is_told_and_is_no_note() -> None:
    copy = {"ready": True, "wanted": True, "size": 2_700_000, "position": {"generation": 1, "sequence": 41}, "why": ""}
    none = {"ready": False, "wanted": True, "size": 0, "position": None, "why": "it is being built"}
    held = COMPONENT | {"role": "standby", "primary": "robot2"}
    components = [held | {"name": "/lab/a", "ready_copy": copy}, held | {"name": "/lab/b", "ready_copy": none}]
    lines = render.plain_tree(STATUS | {"components": components}).splitlines()
    assert lines[-1] == (
        "ready copy at robot1: /lab/a 2.7 MB of memory, at checkpoint 1.41; "
        "/lab/b none, because it is being built: a takeover restores it from its chain"
    )
    assert not any(line.startswith("note") for line in lines)
