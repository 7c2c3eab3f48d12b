"""failover page: what it says before it becomes the page's process."""

from __future__ import annotations

import importlib.util
import io
import sys
import tomllib

import pytest

from failover.cli import main
from failover.config.page import is_password


def test_without_its_libraries_the_cure_is_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert main.main(["page", "--listen", "127.0.0.1:0"]) == main.FAILED
    assert "needs starlette, uvicorn, websockets, not installed here: pip install 'failover[page]'" in capsys.readouterr().err


def test_the_line_of_a_password_is_one_of_page_toml(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("swordfish\n"))
    assert main.main(["page", "--password"]) == 0
    assert is_password("swordfish", tomllib.loads(capsys.readouterr().out)["password"])


def test_an_empty_password_is_refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n"))
    assert main.main(["page", "--password"]) == main.FAILED
    assert "type one" in capsys.readouterr().err
