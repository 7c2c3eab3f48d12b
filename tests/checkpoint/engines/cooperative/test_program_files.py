"""Files from which a program that keeps its state is started again; and how the program sees them where they are missing."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from blake3 import blake3
from msgspec.structs import replace

from checkpoint.engines.cooperative import program_files
from checkpoint.linux.spawn.file_overlay import BroughtFile
from checkpoint.linux.spawn.inherited_limits import Inheritance
from checkpoint.linux.spawn.vessel import Birth, discard, spawn_program
from checkpoint.model import Resource
from tests.checkpoint.round_trip import NOBODY

WAIT = "import sys; print('ready', flush=True); sys.stdin.read()"


@contextmanager
def running(*argv: str, directory: Path) -> Iterator[int]:
    with subprocess.Popen(argv, cwd=directory, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        yield process.pid
        process.kill()


def told(pid: int, *argv: str, directory: Path) -> list[str]:
    found = program_files.describe(pid, "/test", argv, str(directory))
    if found is None:
        return []
    files = found.facts["files"]
    assert isinstance(files, list)
    return [os.path.relpath(str(file[0]), directory) for file in files if isinstance(file, list)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A script, a module beside it, a package with data, and what does not belong to them."""
    for name in ("main.py", "beside.py", "package/__init__.py", "package/deep/__init__.py", "package/deep/module.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(WAIT if name == "main.py" else "")
    for name in ("package/table.csv", "notes.txt", "photos/one.jpg", "package/__pycache__/x.pyc", ".hidden/__init__.py", "a.sh"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "outside.py").symlink_to("/etc/passwd")
    return tmp_path


OUR_GROUP = 61_234
PACKAGE = ["package/__init__.py", "package/deep/__init__.py", "package/deep/module.py", "package/table.csv"]


def test_a_script_goes_with_what_is_of_its_kind_beside_it_and_its_packages(folder: Path) -> None:
    argv = sys.executable, "main.py"
    with running(*argv, directory=folder) as pid:
        found = told(pid, *argv, directory=folder)
    assert found[0] == "main.py"
    assert sorted(found[1:]) == sorted(["beside.py", *PACKAGE])


def test_a_module_of_a_package_goes_with_the_package(folder: Path) -> None:
    (folder / "package" / "deep" / "module.py").write_text(WAIT)
    argv = sys.executable, "-m", "package.deep.module"
    with running(*argv, directory=folder) as pid:
        found = told(pid, *argv, directory=folder)
    assert found[0] == "package/deep/module.py"
    assert set(PACKAGE) < set(found)


def test_what_is_installed_or_has_no_file_belongs_to_no_program(folder: Path) -> None:
    argv = sys.executable, "-c", WAIT, "main.py"
    with running(*argv, directory=folder) as pid:
        assert told(pid, *argv, directory=folder) == []
        assert told(pid, sys.executable, "-m", "json.tool", directory=folder) == []


def test_a_program_of_more_files_than_can_be_told_is_not_told(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(program_files, "FILES_MAX", 4)
    argv = sys.executable, "main.py"
    with running(*argv, directory=folder) as pid:
        assert told(pid, *argv, directory=folder) == []


@pytest.mark.root
def test_a_link_to_what_the_programs_user_may_not_read_brings_him_nothing(reached: Path) -> None:
    """The keeper reads as root, and what is brought is shown to the program."""
    script, closed = reached / "main.py", reached / "closed.py"
    script.write_text(WAIT)
    closed.write_text("secret")
    closed.chmod(0o600)
    as_nobody = ["/usr/bin/setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups"]
    argv = "/usr/bin/python3", "main.py"
    with running(*as_nobody, *argv, directory=reached) as pid:
        found = program_files.describe(pid, "/test", argv, str(reached))
        assert found is not None
        assert [file[0] for file in found.facts["files"]] == [str(script)]  # type: ignore[union-attr,index]
        script.unlink()
        script.symlink_to(closed)
        assert program_files.describe(pid, "/test", argv, str(reached)) is None
        with pytest.raises(PermissionError):
            program_files.open_file(pid, str(script))


def test_a_process_that_has_ended_tells_nothing(folder: Path) -> None:
    assert program_files.describe(2**22 - 7, "/test", (sys.executable, "main.py"), str(folder)) is None


@pytest.fixture
def reached() -> Iterator[Path]:
    """A directory that every user reaches; pytest's own are closed to others."""
    with tempfile.TemporaryDirectory(prefix="brought-") as directory:
        Path(directory).chmod(0o755)
        yield Path(directory)


@pytest.fixture
def content(tmp_path: Path) -> Path:
    """What was brought, where only its keeper may look."""
    kept = tmp_path / "kept"
    kept.mkdir(mode=0o700)
    (kept / "content").write_text("#!/bin/sh\necho ready; id -u; sleep 1000\n")
    return kept / "content"


def born(path: Path, content: Path, *, uid: int = 0, isolate: bool = True, groups: tuple[int, ...] = ()) -> str:
    """Start the program from what was brought; what it says, or why it cannot be."""
    read_end, write_end = os.pipe()
    null = os.open("/dev/null", os.O_RDWR)
    birth = Birth(
        isolate=isolate,
        stdio=(null, write_end, write_end),
        inheritance=Inheritance(uid, uid, groups),
        brought=(BroughtFile(str(path), str(content), 0o755),),
    )
    try:
        program = spawn_program([str(path)], {"PATH": "/usr/bin:/bin"}, "/", 0o022, birth)
    except OSError as error:
        return f"{error.strerror} {error.filename}"
    finally:
        os.close(write_end)
        os.close(null)
    said = os.read(read_end, 4096)
    while said.count(b"\n") < 2 and (more := os.read(read_end, 4096)):
        said += more
    discard(program)
    os.close(read_end)
    return said.decode()


@pytest.mark.root
@pytest.mark.parametrize("uid", [0, NOBODY])
def test_it_is_shown_to_the_program_alone_and_leaves_one_empty_directory(reached: Path, content: Path, uid: int) -> None:
    home = reached / "home"
    home.mkdir()
    os.chown(home, uid, uid)
    assert born(home / "app" / "bin" / "run", content, uid=uid) == f"ready\n{uid}\n"
    assert [(path.name, path.stat().st_uid) for path in home.rglob("*")] == [("app", uid)]
    assert born(home / "app" / "bin" / "run", content, uid=uid) == f"ready\n{uid}\n", "into what it left, too"


@pytest.mark.root
def test_what_stands_there_is_used_and_what_would_be_hidden_is_not(tmp_path: Path, content: Path) -> None:
    program = tmp_path / "app" / "run"
    program.parent.mkdir()
    program.write_text("#!/bin/sh\necho installed; echo; sleep 1000\n")
    program.chmod(0o755)
    assert born(program, content) == "installed\n\n"
    assert "holds other files" in born(program.parent / "another", content)
    assert "mounts of its own" in born(tmp_path / "new" / "run", content, isolate=False)


@pytest.mark.root
def test_a_user_gets_nothing_mounted_where_he_could_not_write(reached: Path, content: Path) -> None:
    """Nor behind a link that leads there: a set-user-id program might believe what it finds."""
    empty, mine = reached / "of-root", reached / "mine"
    empty.mkdir()
    mine.mkdir()
    os.chown(mine, NOBODY, NOBODY)
    (mine / "link").symlink_to(empty)
    assert "belongs to another user" in born(empty / "run", content, uid=NOBODY)
    assert born(mine / "link" / "run", content, uid=NOBODY).startswith(("Not a directory", "Too many levels"))
    assert "Permission denied" in born(reached / "new" / "run", content, uid=NOBODY)


@pytest.mark.root
def test_our_own_groups_open_no_directory_to_a_user(reached: Path, content: Path) -> None:
    """Nor do his that he has not; those that he has do."""
    shared, ours = reached / "shared", os.getgroups()
    shared.mkdir()
    os.chown(shared, 0, OUR_GROUP)
    shared.chmod(0o775)
    os.setgroups([OUR_GROUP])
    try:
        assert "Permission denied" in born(shared / "app" / "run", content, uid=NOBODY)
        assert list(shared.iterdir()) == []
        assert born(shared / "app" / "run", content, uid=NOBODY, groups=(OUR_GROUP,)) == f"ready\n{NOBODY}\n"
        assert os.getgroups() == [OUR_GROUP]
    finally:
        os.setgroups(ours)


def test_a_resource_that_says_anything_else_names_no_file() -> None:
    from checkpoint.snapshot.required_files import program_of
    from tests.checkpoint.snapshots import page, snapshot

    made = snapshot({1: page("x")})
    facts = {"files": [["/a/../etc/shadow", 1, bytes(32), 0o4755], ["relative", 1, b"", 0], "x", ["/fine", 1, bytes(32), 0o6755]]}
    found = program_of(replace(made, resources=(Resource("program", "/test", facts),)))  # type: ignore[arg-type]
    assert [(file.path, file.mode) for file in found] == [("/fine", 0o755)]


@pytest.mark.root
def test_nothing_is_read_for_a_program_that_its_user_may_not_read() -> None:
    """It chooses its own arguments, and where the links in its directory lead."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        (folder / "closed").write_text("nobody else's business")
        (folder / "closed").chmod(0o600)
        (folder / "link.sh").symlink_to(folder / "closed")
        (folder / "own.sh").write_text("")
        words = ["/bin/sh", "-c", "echo ready; read line"]
        pipe = subprocess.PIPE
        with subprocess.Popen(words, user=NOBODY, group=NOBODY, extra_groups=[], stdin=pipe, stdout=pipe) as process:
            assert process.stdout is not None and process.stdout.readline() == b"ready\n"
            digests = {}
            for script in ("own.sh", "link.sh", "closed"):
                found = program_files.describe(process.pid, "/test", ("/bin/sh", script), name)
                digests |= {str(file[0]): file[2] for file in found.facts["files"]} if found else {}  # type: ignore[union-attr,index]
            with pytest.raises(PermissionError):
                program_files.open_file(process.pid, str(folder / "closed"))
            process.kill()
    assert digests == {f"{name}/own.sh": blake3(b"").digest()}
