"""The wheel: it installs one name, and runs beside modules of others that are called as ours are in a checkout."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from failover.cli.demo import robots as demo
from hatch_build import Rewriter
from tests.e2e import robots

ROOT = Path(__file__).parents[2]
PLACES = {"agent": "failover._agent", "checkpoint": "failover._checkpoint", "page": "failover._page"}
FOLDERS = {name: f"{place.replace('.', '/')}/" for name, place in PLACES.items()}
MENTIONED = re.compile(rf"\b(?:{'|'.join(PLACES)})\.|\b(?:import|from) +(?:{'|'.join(PLACES)})\b")
DOTTED = re.compile(rf"\b(?:{'|'.join(PLACES)})(?:\.\w+)+")

KEEPS = """
import time
import agent, checkpoint, page
import failover

state = failover.resume("keeps", default={"n": 0})
for _ in failover.every(0.01):
    print(state["n"], flush=True)
    state["n"] += len({agent.OWNER, checkpoint.OWNER, page.OWNER})
"""
UNPREPARED = """
import time
import agent, checkpoint, page

n = 0
while True:
    print(n, flush=True)
    n += len({agent.OWNER, checkpoint.OWNER, page.OWNER})
    time.sleep(0.01)
"""
LOADS_ALL = """
import importlib, pkgutil
import failover

for module in pkgutil.walk_packages(failover.__path__, "failover."):
    try:
        importlib.import_module(module.name)
    except ImportError as error:
        print(error.name)
"""


def built(target: str, source: Path, directory: Path) -> Path:
    """The wheel or the archive of sources, made as `pip` would have it made."""
    command = [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(directory)]
    subprocess.run(command, cwd=source, check=True, capture_output=True)
    (made,) = directory.iterdir()
    return made


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built("wheel", ROOT, tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bin directory of an environment with the wheel, and with the libraries of ours."""
    place = tmp_path_factory.mktemp("environment")
    venv.create(place, symlinks=True)
    python = place / "bin/python"
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", str(python)]
    subprocess.run([*pip, "install", "--quiet", "--no-deps", "--no-index", str(wheel)], check=True)
    (site,) = (place / "lib").glob("python3*/site-packages")
    (site / "libraries.pth").write_text(f"{sysconfig.get_path('purelib')}\n{sysconfig.get_path('platlib')}\n")
    return python.parent


@pytest.fixture
def hostile(tmp_path: Path) -> Path:
    """A user's directory with modules called as ours."""
    place = tmp_path / "user"
    place.mkdir()
    for name in PLACES:
        (place / f"{name}.py").write_text('OWNER = "the user"\n')
    return place


def said(command: list[str | Path], cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=cwd, env=os.environ | environment, capture_output=True, text=True, check=False)


def test_a_wheel_has_one_name_and_its_files_use_no_other(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        files = {name: archive.read(name).decode() for name in archive.namelist()}
        assert len(files) == len(archive.namelist())
    assert {re.split("[/-]", name)[0] for name in files} == {"failover"}
    for name, text in files.items():
        if name.endswith(".py"):
            source = next((f"{one}/{name.removeprefix(place)}" for one, place in FOLDERS.items() if name.startswith(place)), name)
            assert text.count("\n") == (ROOT / source).read_text().count("\n"), "tracebacks name the same lines"
            assert list(named(text)) == [], source


def named(text: str) -> Iterator[str]:
    """What a module imports, or names in a string, by the name that a checkout has for it."""
    if not MENTIONED.search(text):
        return
    tree = ast.parse(text)
    notes = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        match node:
            case ast.Import():
                yield from (one.name for one in node.names if one.name.split(".")[0] in PLACES)
            case ast.ImportFrom(module=str(name)) if name.split(".")[0] in PLACES:
                yield name
            case ast.Constant(value=str(words)) if id(node) not in notes:
                yield from (one[0] for one in DOTTED.finditer(words) if is_module(one[0]))


def is_module(name: str) -> bool:
    path = ROOT / name.replace(".", "/")
    return path.with_suffix(".py").exists() or (path / "__init__.py").exists()


def test_the_archive_of_the_sources_makes_the_same_wheel(wheel: Path, tmp_path: Path) -> None:
    with tarfile.open(built("sdist", ROOT, tmp_path / "sdist")) as archive:
        archive.extractall(tmp_path)
    (source,) = tmp_path.glob("failover-*/")
    assert built("wheel", source, tmp_path / "again").read_bytes() == wheel.read_bytes()


def test_commands_of_a_wheel_take_no_module_of_a_user_for_ours(installed: Path, hostile: Path, tmp_path: Path) -> None:
    nothing = tmp_path / "nothing"
    nothing.mkdir()
    for name in PLACES:
        assert f"No module named '{name}'" in said([installed / "python", "-c", f"import {name}"], nothing).stderr
    around = {"PYTHONPATH": str(hostile)}
    lacking = said([installed / "python", "-c", LOADS_ALL], hostile, **around)
    assert lacking.returncode == 0 and not {one.split(".")[0] for one in lacking.stdout.split()} & {*PLACES, "failover"}, lacking
    version = said([installed / "failover", "--version"], hostile, **around)
    assert (version.returncode, version.stdout.split()[:2]) == (0, ["failover", "0.1.0"])
    asked = said([installed / "python", "-m", "failover", "check", "--table"], hostile, **around)
    assert (asked.returncode, asked.stderr) == (0, "") and "threads" in asked.stdout


def test_programs_of_a_wheel_outlive_their_robot_beside_modules_of_a_user(
    installed: Path, hostile: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    around = {"PYTHONPATH": str(hostile)}
    started = ["/usr/bin/env", "-C", str(hostile), f"PYTHONPATH={hostile}", str(installed / "failover-agent")]
    monkeypatch.setattr(demo, "agent_command", lambda config: [*started, "--config", str(config)])
    with robots.two_robots(tmp_path) as (first, second):
        for name, script, engine in (("keeps", KEEPS, "cooperative"), ("unprepared", UNPREPARED, "ptrace")):
            (hostile / f"{name}.py").write_text(script)
            robots.run(first, name, str(installed / "python"), f"{name}.py", env=around, cwd=str(hostile), engine=engine)
            robots.until_protected(first, name)
        status = said([installed / "failover", "status", "--socket", first.socket], hostile, **around)
        assert "unprepared" in status.stdout, status
        robots.counts_on_elsewhere(first, second, 10, "unprepared")
        robots.until_taken_over(second, "keeps")
        before = len(robots.numbers(second, "keeps"))
        robots.until(lambda: len(robots.numbers(second, "keeps")) > before + 10, "it to go on")
        counted = robots.numbers(second, "keeps")
        assert counted == list(range(len(counted)))


REWRITER = Rewriter(PLACES, frozenset({"agent", "agent.guard", "agent.guard.server", "page", "failover.page"}))


@pytest.mark.parametrize(
    ("line", "rewritten"),
    [
        ("import agent", "import failover._agent as agent"),
        ("import os, agent.guard as guard, page as p", "import os, failover._agent.guard as guard, failover._page as p"),
        (
            "if ä := 'é': from agent.guard import (server, agent)",
            "if ä := 'é': from failover._agent.guard import (server, agent)",
        ),
        ("x = ['-m', 'agent.guard.server', \"agent\"]", "x = ['-m', 'failover._agent.guard.server', \"agent\"]"),
        *((same, same) for same in ("from failover import page", "import agents", "x = 'agent.toml'", "# import agent")),
        *((same, same) for same in ("x = 'see agent.guard'", "from . import agent", "x = 'failover.page'", "agent.guard.server")),
    ],
)
def test_what_names_a_module_is_rewritten_and_nothing_else(line: str, rewritten: str) -> None:
    assert REWRITER.rewritten(line.encode(), "x.py").decode() == rewritten


@pytest.mark.parametrize(
    "line", ["import agent.guard", "x = 'agent.' 'guard'", "x = f'agent.guard{1}'", "import  os,\\\n  agent.guard"]
)
def test_what_cannot_be_rewritten_ends_the_build(line: str) -> None:
    with pytest.raises(SyntaxError, match=r"^x\.py:1: the wheel cannot rename agent\.guard: "):
        REWRITER.rewritten(line.encode(), "x.py")
