"""failover archive key, list, fetch: as a person types them, with a real program that is captured, archived and started again."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from blake3 import blake3
from msgspec.structs import replace

from checkpoint.snapshot import format
from checkpoint.snapshot.required_files import needs
from checkpoint.store.index import folder_name
from failover.archive import keys, signature
from failover.archive.archive import Archive
from failover.archive.objects import FolderObjects
from failover.cli import main
from failover.config import team as team_directory
from failover.errors import ArchiveError
from tests.checkpoint.snapshots import COMPONENT, page, snapshot

pytest.importorskip("cryptography")


@pytest.fixture
def team(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    """A team directory as a new machine has it, with an archive key."""
    directory = tmp_path / "team"
    directory.mkdir()
    (directory / "team.toml").write_text('team = "lab"\n')
    (tmp_path / "place").mkdir()
    assert main.main(["archive", "key", "--directory", str(directory)]) == 0
    assert f"{directory}/keys/archive.key is the archive key: carry it" in capsys.readouterr().out
    return directory


def test_the_public_half_is_written_beside_a_key_that_has_none(team: Path, capsys: pytest.CaptureFixture[str]) -> None:
    public, key = signature.public_path(team), keys.key_path(team).read_bytes()
    expected = signature.public_of(keys.read_key(team))
    assert signature.read_public(team) == expected and public.stat().st_mode & 0o777 == 0o644
    public.unlink()
    assert main.main(["archive", "key", "--directory", str(team)]) == 0
    assert signature.read_public(team) == expected and keys.key_path(team).read_bytes() == key
    said = capsys.readouterr().out
    assert f"{public} opens nothing: carry it" in said and f"{keys.recovery_path(team)} opens each copy when" in said
    aside = keys.recovery_path(team).rename(team / "aside")
    public.unlink()
    assert main.main(["archive", "key", "--directory", str(team)]) == 0
    assert "archive.recovery" not in capsys.readouterr().out
    aside.rename(keys.recovery_path(team))
    keys.key_path(team).unlink()
    assert main.main(["archive", "key", "--directory", str(team)]) == main.FAILED
    assert f"{keys.recovery_path(team)} exists, and what was sealed with it needs it" in capsys.readouterr().err
    keys.recovery_path(team).unlink()
    assert main.main(["archive", "key", "--directory", str(team)]) == main.FAILED
    assert "belongs to another archive key: remove it" in capsys.readouterr().err
    for spoiled in ("", "ab", "x" * 64):
        public.write_text(spoiled)
        with pytest.raises(ArchiveError, match="holds no public key of 64 hexadecimal digits; failover archive key writes it"):
            signature.read_public(team)
    public.unlink()
    with pytest.raises(ArchiveError, match=r"cannot read .*archive\.public: No such file"):
        signature.read_public(team)


def archive(team: Path) -> Archive:
    return Archive(FolderObjects(team.parent / "place"), keys.read_keys(team, team_directory.read(team)), "lab", team.parent)


def put(team: Path, content: bytes) -> None:
    with tempfile.TemporaryFile() as file:
        file.write(content)
        file.flush()
        archive(team).put(file, "robot1")


def asked(team: Path, act: str, *words: str) -> int:
    return main.main(["archive", act, *words, "--directory", str(team), "--place", str(team.parent / "place")])


def answer(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    told: dict[str, Any] = json.loads(capsys.readouterr().out)
    return told


def test_the_copies_are_listed_the_newest_first(team: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert asked(team, "list") == 0
    assert "no checkpoint is in the archive" in capsys.readouterr().out
    for sequence in (1, 2):
        put(team, format.encode_bytes(snapshot({1: page("x")}, sequence=sequence)))
    put(team, format.encode_bytes(snapshot({1: page("x")}, component="/lab/robot2/mapper")))
    assert asked(team, "list") == 0
    said = capsys.readouterr().out
    assert COMPONENT in said and "/lab/robot2/mapper" in said
    assert asked(team, "list", "robot1/mapper", "--json") == 0
    assert [copy["sequence"] for copy in answer(capsys)["copies"]] == [2, 1]
    assert asked(team, "list", "mapper") == main.FAILED
    assert "could be /lab/robot1/mapper, /lab/robot2/mapper; give the whole name" in capsys.readouterr().err


def test_a_copy_is_fetched_whole_or_not_at_all(team: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for sequence in (1, 2):
        put(team, format.encode_bytes(snapshot({1: page(str(sequence))}, sequence=sequence)))
    output = tmp_path / "mapper.snapshot"
    assert asked(team, "fetch", "mapper", "--output", str(output), "--json") == 0
    told = answer(capsys)
    assert (told["sequence"], told["robot"], told["missing"]) == (2, "robot1", ["/usr/bin/mapper"])
    assert format.decode(output).contents[:1] == b"2" and output.stat().st_mode & 0o777 == 0o600
    assert asked(team, "fetch", "mapper", "--output", str(output)) == main.FAILED
    assert "File exists" in capsys.readouterr().err and format.decode(output).contents[:1] == b"2"
    older, newer = sorted((team.parent / "place").rglob("*.sealed"))
    newer.write_bytes(newer.read_bytes()[:-1])
    other = tmp_path / "other"
    assert asked(team, "fetch", "mapper", "--output", str(other)) == main.FAILED
    assert "altered, cut off" in capsys.readouterr().err and not other.exists()
    name = older.relative_to(team.parent / "place").as_posix()
    assert asked(team, "fetch", "mapper", "--output", str(other), "--object", name) == 0
    assert "it needs /usr/bin/mapper, which is neither here nor whole in the archive" in capsys.readouterr().out
    assert format.decode(other).contents[:1] == b"1"


@pytest.mark.root
def test_a_program_starts_from_the_archive_where_its_own_files_are_gone(
    team: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    program = tmp_path / "program"
    shutil.copy(shutil.which("sleep") or "/bin/sleep", program)
    with subprocess.Popen([program, "100000"], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, cwd="/") as process:
        captured = tmp_path / "captured"
        assert main.main(["capture", str(process.pid), "--output", str(captured)]) == 0
        process.kill()
    put(team, captured.read_bytes())
    for need in needs(format.read_outline(captured)):
        with open(need.path, "rb") as file:
            archive(team).put_content(need.digest, file)
    program.unlink()
    capsys.readouterr()
    (copy,) = archive(team).copies()
    output = tmp_path / "fetched"
    assert asked(team, "fetch", copy.component, "--output", str(output), "--json") == 0
    told = answer(capsys)
    assert told["brought"] == [str(program)] and told["missing"] == []
    assert main.main(["restore", str(output)]) == main.FAILED, "its program is not here"
    assert not program.exists(), "nothing is laid down where a snapshot says"
    capsys.readouterr()
    assert main.main(["restore", "--json", str(output), "--contents", told["contents"]]) == 0
    pid = answer(capsys)["pid"]
    try:
        assert os.readlink(f"/proc/{pid}/exe").startswith(told["contents"])
    finally:
        os.kill(pid, signal.SIGKILL)


def test_a_folder_of_contents_that_is_there_already_is_not_used(
    team: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = os.urandom(3_000_000)
    made = snapshot({1: page("x")})
    executable = type(made.process.executable)("/opt/mapper", size=len(content), digest=blake3(content).digest())
    put(team, format.encode_bytes(replace(made, process=replace(made.process, executable=executable))))
    with tempfile.TemporaryFile() as file:
        file.write(content)
        file.flush()
        archive(team).put_content(executable.digest, file)
    output, contents = tmp_path / "mapper.snapshot", tmp_path / "mapper.snapshot.contents"
    contents.mkdir()
    assert asked(team, "fetch", "mapper", "--output", str(output)) == main.FAILED
    assert f"cannot write {contents}: File exists" in capsys.readouterr().err
    assert not output.exists() and list(contents.iterdir()) == []
    contents.rmdir()
    (harmed,) = (team.parent / "place").rglob("contents/*.sealed")
    whole = harmed.read_bytes()
    harmed.write_bytes(whole[:2000] + bytes([whole[2000] ^ 1]) + whole[2001:])
    assert asked(team, "fetch", "mapper", "--output", str(output)) == main.FAILED
    assert not output.exists() and not contents.exists()
    harmed.write_bytes(whole[:-1])
    assert asked(team, "fetch", "mapper", "--output", str(tmp_path / "without")) == 0
    assert "it needs /opt/mapper, which is neither here nor whole" in capsys.readouterr().out
    harmed.write_bytes(whole)
    assert asked(team, "fetch", "mapper", "--output", str(output)) == 0
    assert [path.read_bytes() for path in contents.iterdir()] == [content]


def test_a_configuration_that_cannot_be_read_is_named(
    team: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    config = tmp_path / "agent.toml"
    monkeypatch.setattr("failover.cli.verbs.archive.CONFIG", config)
    for text, said in (
        (None, "no archive is named"),
        ("[store", "does not say where the archive is"),
        ('[store]\ns3 = "x"\n', "which is no place"),
        ('[store]\nwitness = "gate"\n', "the copies are at witness gate, which gives them to agents: failover-agent recover"),
    ):
        if text is not None:
            config.write_text(text)
        assert main.main(["archive", "list", "--directory", str(team)]) == main.FAILED
        assert said in capsys.readouterr().err
    config.write_text(f'[store]\ns3 = "{team.parent}/place"\n')
    assert main.main(["archive", "list", "--directory", str(team)]) == 0


def test_a_component_whose_name_was_too_long_for_an_object_is_found_by_its_name(
    team: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = ["/lab/robot1/" + "m" * 300 + end for end in ("a", "b")]
    for name in names:
        put(team, format.encode_bytes(snapshot({1: page("x")}, component=name)))
    assert asked(team, "list", names[1], "--json") == 0
    (copy,) = answer(capsys)["copies"]
    assert folder_name(names[1]) in copy["object"]


def test_the_time_that_a_copy_was_sealed_is_told_and_a_clock_that_was_wrong(
    team: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        for sequence, now_s in ((1, 1_000_000_000.0), (2, 900_000_000.0)):
            patch.setattr("failover.archive.archive.time", SimpleNamespace(time=lambda now_s=now_s: now_s))
            put(team, format.encode_bytes(snapshot({1: page("x")}, sequence=sequence)))
    for path in (team.parent / "place").rglob("*.sealed"):
        os.utime(path, (0, 0))  # the owner of the place says what he likes
    assert asked(team, "list") == 0
    assert capsys.readouterr().out.count("2001-09-09 01:46:40 UTC") == 2
    assert asked(team, "fetch", "mapper", "--output", str(tmp_path / "out")) == 0
    said = capsys.readouterr().out
    assert "as robot1 archived it at 1998-07-09 16:00:00 UTC" in said and "its name says 2001-09-09 01:46:40 UTC" in said
