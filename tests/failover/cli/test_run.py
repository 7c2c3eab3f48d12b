"""Messages of ``failover run`` when it cannot wait any longer."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from failover.cli import main
from failover.cli.verbs import components
from failover.errors import NoAgentError


def test_an_agent_that_does_not_come_back_is_given_up_with_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(components, "RECONNECT_S", 0.0)
    monkeypatch.setattr(components, "RECONNECT_EVERY_S", 0.0)
    arguments = argparse.Namespace(socket=tmp_path / "control.sock", json=False)
    with pytest.raises(NoAgentError, match="/lab/r1/mapper runs on without it: start failover-agent") as gone:
        components.reconnect(arguments, "/lab/r1/mapper")
    assert main.tell(gone.value, arguments, main.NO_AGENT) == 3
