"""An invitation that ends badly: an agent that is lost, a message that is none, files too large, a join that broke off."""

from __future__ import annotations

import argparse
import io
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from failover.cli import agent_service
from failover.cli.verbs import team_invitations
from failover.config import team
from failover.config.invitation import SECRET_SIZE, Invitation
from failover.config.team import Robot, Team
from failover.core.wire.messages import VERSION
from failover.errors import InvitationError, LostAgentError, TeamFileError

MEMBER = Robot(("127.0.0.1:7440",), "127.0.0.1:7441", public_key="b" * 40)
GIVEN = Invitation("r2", "127.0.0.1", 7423, bytes(SECRET_SIZE))


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """Of r1's team."""
    team.write(tmp_path, Team("lab", {"r1": Robot(("127.0.0.1:7430",), "127.0.0.1:7431", public_key="a" * 40)}))
    return tmp_path


def welcomed(place: Path, wish: Any) -> team_invitations.Welcome:
    arguments = argparse.Namespace(directory=str(place), socket=str(place / "none"), role="robot")
    content = wish if isinstance(wish, bytes) else msgspec.msgpack.encode(wish)
    return team_invitations._welcome(arguments, "r2", content)


def test_a_robot_that_the_agent_took_before_it_was_lost_is_welcome(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    is_taken = True

    def lose(_arguments: Any, _act: str, robot: str, member: Robot) -> None:
        if is_taken:
            team.write(place, team.enrol(team.read(place), robot, member))
        raise LostAgentError("the agent ended during team")

    monkeypatch.setattr(team_invitations, "change_by_agent", lose)
    wish = team_invitations.Wish(VERSION, "r2", MEMBER)
    assert "r2" in welcomed(place, wish).files[team.TEAM_FILE].decode()
    team.write(place, Team("lab", {"r1": team.read(place).robots["r1"]}))
    is_taken = False
    assert "ended during team" in welcomed(place, wish).refusal


def test_files_that_cannot_travel_are_told_before_the_team_changes(place: Path) -> None:
    (place / "rights.toml").write_bytes(b"#" * (team_invitations.FILES_SIZE_MAX + 1))
    assert "can travel" in welcomed(place, team_invitations.Wish(VERSION, "r2", MEMBER)).refusal
    (place / "rights.toml").unlink()
    (place / "rights.toml").mkdir()
    assert welcomed(place, team_invitations.Wish(VERSION, "r2", MEMBER)).refusal
    assert list(team.read(place).robots) == ["r1"]


def test_another_role_than_the_invitations_and_bytes_that_are_no_message_are_refused(place: Path) -> None:
    witness = Robot(MEMBER.beats, MEMBER.bulk, "witness", MEMBER.public_key)
    assert "is for a robot" in welcomed(place, team_invitations.Wish(VERSION, "r2", witness)).refusal
    for bad in (b"", b"\xc1", b"\x81\xa5robot\xa1\xff", b"\x81\xa1x" + b"\x91" * 100_000):
        assert "not understood" in welcomed(place, bad).refusal
    with pytest.raises(InvitationError, match="is not understood"):
        team_invitations._understood(b"\x81\xa1x" + b"\x91" * 100_000, GIVEN)


def test_only_the_robot_that_was_admitted_confirms() -> None:
    came = [(b"other", b""), (b"it", b"more"), (b"it", b"")]
    listener: Any = SimpleNamespace(next=lambda _timeout_ms: came.pop(0))
    assert team_invitations._is_confirmed(listener, b"it") and not came


def test_a_join_after_one_that_broke_off_sets_its_key_aside_and_writes_the_team_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stray = team.write_secret_key(tmp_path, "r2", "x" * 40)
    team_invitations._set_stray_key_aside(tmp_path, "r2")
    assert not stray.exists() and stray.with_suffix(".former").read_text().strip() == "x" * 40
    written: list[str] = []
    whole = team_invitations.write_whole

    def note(path: Path, content: bytes, **how: Any) -> None:
        written.append(path.name)
        whole(path, content, **how)

    monkeypatch.setattr(team_invitations, "write_whole", note)
    content = b'team = "lab"\n[robots.r2]\nbeats = ["127.0.0.1:7440"]\nbulk = "127.0.0.1:7441"\n'
    team_invitations._write(tmp_path, "r2", "y" * 40, {team.TEAM_FILE: content, "rights.toml": b"", "programs.toml": b""})
    assert written == ["rights.toml", "programs.toml", "team.toml"]


def test_the_line_is_asked_for_and_as_an_argument_it_is_warned_of(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO(GIVEN.line + "\n"))
    assert team_invitations._line("-") == GIVEN.line and not capsys.readouterr().err
    assert team_invitations._line(GIVEN.line) == GIVEN.line and "on the command line" in capsys.readouterr().err
    with pytest.raises(InvitationError, match="no line came"):
        team_invitations._line("-")


def test_a_service_that_does_not_start_in_time_is_told_in_a_sentence(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def hang(command: list[str], **_: Any) -> None:
        raise subprocess.TimeoutExpired(command, 90)

    monkeypatch.setattr(agent_service, "SYSTEM_DIRECTORY", tmp_path)
    monkeypatch.setattr(agent_service, "RUNS_SYSTEMD", tmp_path)
    monkeypatch.setattr(subprocess, "run", hang)
    with pytest.raises(TeamFileError, match="did not end well"):
        agent_service.start(tmp_path)
