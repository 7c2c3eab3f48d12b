"""The documents: every link leads to a target, every command line can be typed, every key and class is documented."""

from __future__ import annotations

import dataclasses
import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest

import agent.errors
import agent.main
import checkpoint.errors
import failover.errors
from agent.alerts_config import AlertsConfig
from agent.config import ComponentConfig, Config, HooksConfig, MediumConfig
from agent.coordinator_config import CoordinatorConfig
from agent.worker.control import status_view
from agent.worker.network.replication_link import LinkState
from failover.cli import parser
from failover.config.board import BoardConfig, ItemConfig
from failover.config.page import PageConfig, UserConfig
from failover.config.programs import KeyConfig
from failover.config.rights import LdapConfig, RightsConfig, RuleConfig
from failover.config.store import StoreConfig
from failover.config.team import Robot

ROOT = Path(__file__).parent.parent
DOCUMENTS = sorted(
    path for floor in ("", "*/", "*/*/", "*/*/*/") for path in ROOT.glob(f"{floor}*.md") if ".venv" not in path.parts
)

named = pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.relative_to(ROOT).as_posix())


# --- Links -----------------------------------------------------------------------------------------------------------


def anchors(text: str) -> set[str]:
    """What a link may name after #: the headings, as the usual sites make anchors of them."""
    headings = re.findall(r"^#+ (.+)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def broken(path: Path, text: str) -> list[str]:
    """The relative links of a document that lead nowhere."""
    wrong = []
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", target):
            continue
        file, _, anchor = target.partition("#")
        there = (path.parent / file).resolve() if file else path
        if not there.exists() or (anchor and anchor not in anchors(there.read_text())):
            wrong.append(target)
    return wrong


@named
def test_every_link_leads_somewhere(path: Path) -> None:
    assert broken(path, path.read_text()) == []


def test_a_link_that_leads_nowhere_is_seen() -> None:
    text = "[a](nowhere.md) [b](README.md#no-such-heading) [c](README.md#licence) [d](docs) [e](https://example.org)"
    assert broken(ROOT / "CHANGELOG.md", text) == ["nowhere.md", "README.md#no-such-heading"]


# --- Command lines ---------------------------------------------------------------------------------------------------


def command_lines(text: str) -> list[list[str]]:
    """What a document tells to type, in words: lines of code blocks, and spans of code with options, that begin with ours."""
    fenced = re.findall(r"```(\w*)\n(.*?)```", text, flags=re.DOTALL)
    blocks = [block for language, block in fenced if language != "layers"]  # those are parts of the product
    spans = re.findall(r"`([^`\n]+ --[^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    lines = [part for block in blocks for line in block.splitlines() for part in re.split(r"&&|\|", line.partition("  #")[0])]
    found = [re.split(r"\s[<>]", line.strip())[0] for line in (*lines, *spans)]
    return [shlex.split(line, comments=True) for line in found if re.match(r"(\.venv/bin/)?failover(-agent)?( [^( ]|$)", line)]


def is_accepted(words: list[str]) -> bool:
    """Whether argparse takes a command line. What stands in capitals is the reader's to fill in: a process, for one."""
    command, *arguments = words
    room = agent.main.command_line() if command.endswith("-agent") else parser.build()
    try:
        room.parse_args(["4711" if word == "PID" else word for word in arguments])
    except SystemExit as ending:
        return ending.code == 0  # --help
    return True


@named
def test_every_command_line_can_be_typed(path: Path) -> None:
    assert [words for words in command_lines(path.read_text()) if not is_accepted(words)] == []


def test_examples_in_help_can_be_typed() -> None:
    examples = [
        line.strip() for verb in parser.VERBS for line in verb.description.splitlines() if line.strip().startswith("failover ")
    ]
    lines = command_lines("```\n" + "\n".join(line for line in examples if not re.search(r"[.;)]$|ACT", line)) + "\n```")
    assert len(lines) > 20
    assert [words for words in lines if not is_accepted(words)] == []


@pytest.mark.parametrize(
    "line", ["failover capture 4711 --to F", "failover protect", "failover status --wach", "failover-agent fly"]
)
def test_a_command_line_that_cannot_be_typed_is_seen(line: str) -> None:
    (words,) = command_lines(f"```\n{line}    # a comment\n```")
    assert not is_accepted(words)


# --- Tables ----------------------------------------------------------------------------------------------------------


def rows(path: Path, heading: str) -> dict[str, str]:
    """First column → second column of the table below a heading, without back ticks."""
    part = path.read_text().split(f"\n## {heading}\n")[1].split("\n## ")[0]
    cells = [[cell.strip().strip("`") for cell in line.strip("|").split("|")] for line in part.splitlines() if line[:3] == "| `"]
    return {line[0]: line[1] for line in cells}


def defaults(kind: type[Any]) -> dict[str, object]:
    """Of a frozen dataclass of settings; a key that must be given has none."""
    found = {one.name: one.default for one in dataclasses.fields(kind) if one.default is not dataclasses.MISSING}
    return {name: list(default) if isinstance(default, tuple) else default for name, default in found.items()}


@pytest.mark.parametrize(
    ("heading", "kind"),
    [
        ("agent.toml: one robot", Config),
        ("agent.toml: one component", ComponentConfig),
        ("agent.toml: one medium", MediumConfig),
        ("agent.toml: hooks of one component", HooksConfig),
        ("agent.toml: alerts", AlertsConfig),
        ("agent.toml: store", StoreConfig),
        ("agent.toml: coordinator", CoordinatorConfig),
        ("team.toml: who belongs", Robot),
        ("team.toml: the board", BoardConfig),
        ("team.toml: one item of the board", ItemConfig),
        ("rights.toml: who may do what", RightsConfig),
        ("rights.toml: one rule", RuleConfig),
        ("page.toml: the operators' page", PageConfig),
        ("page.toml: one user", UserConfig),
        ("programs.toml: one key", KeyConfig),
        ("rights.toml: the directory server", LdapConfig),
    ],
)
def test_every_key_and_its_default_are_told(heading: str, kind: type[Any]) -> None:
    told = rows(ROOT / "docs" / "configuration.md", heading)
    assert set(told) == {one.name for one in dataclasses.fields(kind)}
    written = {key: tomllib.loads(f"value = {text}")["value"] for key, text in told.items() if key in defaults(kind)}
    assert written == defaults(kind)


def error_classes() -> set[str]:
    """The classes of all three floors, without the families' heads."""
    floors = (checkpoint.errors, failover.errors, agent.errors)
    heads = {"CheckpointError", "FailoverError", "AgentError"}
    return {name for floor in floors for name, kind in vars(floor).items() if isinstance(kind, type)} - heads


def test_every_class_of_error_has_its_cause_and_cure() -> None:
    table = (ROOT / "docs" / "troubleshooting.md").read_text().split("\n## Classes of errors\n")[1].split("\n## ")[0]
    told = {name for line in table.splitlines() for name in re.findall(r"`(\w+Error)`", line.partition(" | ")[0])}
    assert error_classes() <= told


def test_every_word_of_the_status_is_told() -> None:
    text = (ROOT / "docs" / "guide.md").read_text().split("## 5.")[1].split("## 6.")[0]
    of_components = set(status_view.STATES.values()) - {"absent", "released"}  # these are not shown
    of_robots = {"unknown", "live", "suspect", "restarting", "dead"}
    words = of_components | of_robots | {"degraded"} | {str(state) for state in LinkState}
    assert [word for word in sorted(words) if not re.search(rf"\*{word}\b", text)] == []
