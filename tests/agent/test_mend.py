"""``failover-agent mend``: corrects a record whose epoch leaves none above it, on the order of a person who was told the cost."""

from __future__ import annotations

from pathlib import Path

import pytest

from agent.main import main
from agent.main_loop.vote_record import VoteRecordFile
from checkpoint.store.store import open_store
from failover.config import team
from failover.config.team import Robot, Team
from failover.core import types
from failover.core import vote_record as core_vote_record
from failover.core.types import EPOCH_MAX, Launch, Record, State

NAME = "/lab/robot1/mapper"
SPEC = types.ComponentSpec(NAME, launch=Launch(("x",)), owner=1000)
POISONED = Record(
    NAME,
    EPOCH_MAX - 1,
    "robot2",
    State.STANDBY,
    ("robot1",),
    True,
    spec=SPEC,
)
OTHER = Record("/lab/robot1/other", 3, "robot1", State.PRIMARY)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """Of a robot whose agent is stopped and whose vote record has two records."""
    directory = tmp_path / "team"
    directory.mkdir()
    members = Team("lab", {"robot1": Robot(("127.0.0.1:7420",), "127.0.0.1:7421")})
    team.write(directory, members)
    for name in ("state", "run"):
        (tmp_path / name).mkdir(mode=0o700)
    path = tmp_path / "agent.toml"
    path.write_text(
        f'robot = "robot1"\nteam_directory = "{directory}"\nstate_directory = "{tmp_path}/state"\n'
        f'runtime_directory = "{tmp_path}/run"\ninsecure = true\n'
    )
    record_file = VoteRecordFile(tmp_path / "state", "robot1")
    record_file.open()
    record_file.keep(core_vote_record.encode(types.VoteRecord((POISONED, OTHER))))
    open_store(tmp_path / "state" / "store").close()
    return path


def records(config: Path) -> tuple[Record, ...]:
    return core_vote_record.decode(VoteRecordFile(config.parent / "state", "robot1").read().core).records


def test_it_tells_the_cost_and_changes_nothing_until_it_is_agreed_to(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["mend", NAME, "--epoch", "12", "--config", str(config)]) == 1
    said = capsys.readouterr().err
    assert "its vote of a later epoch" in said and "fencing" in said and "nothing was changed; --yes does it" in said
    assert records(config) == (POISONED, OTHER)


def test_a_store_that_cannot_be_used_is_named_and_nothing_changes(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = open_store(config.parent / "state" / "store")
    assert main(["mend", NAME, "--epoch", "12", "--yes", "--config", str(config)]) == 1
    store.close()
    said = capsys.readouterr().err
    assert f"failover-agent: cannot mend {NAME}: " in said and f"its record has epoch {EPOCH_MAX - 1} still" in said
    assert "checkpoints of later epochs may be set aside already" in said and "give the command again" in said
    assert records(config) == (POISONED, OTHER)


def test_it_lowers_the_one_record_and_leaves_no_vote_in_it(config: Path) -> None:
    assert main(["mend", NAME, "--epoch", "12", "--yes", "--config", str(config)]) == 0
    mended, other = records(config)
    assert (mended.epoch, mended.primary, mended.entrusted, mended.trusted, mended.spec) == (12, "", (), False, POISONED.spec)
    assert other == OTHER
    assert VoteRecordFile(config.parent / "state", "robot1").open().boot == 2, "it was no life of the agent"


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("/lab/robot1/unknown", "--epoch", "12"), "has no record of '/lab/robot1/unknown'"),
        ((NAME, "--epoch", "0"), "mending gives it a lower one"),
        ((NAME, "--epoch", str(EPOCH_MAX)), "mending gives it a lower one"),
        ((NAME,), "mend needs a component and the epoch"),
        (("--epoch", "12"), "mend needs a component and the epoch"),
    ],
)
def test_what_cannot_be_mended_is_refused_in_a_sentence(
    config: Path, words: tuple[str, ...], why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["mend", *words, "--yes", "--config", str(config)]) == 1
    assert why in capsys.readouterr().err and records(config) == (POISONED, OTHER)


def test_it_refuses_while_the_program_runs_here(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from agent.worker.components.run_records import Records

    Records(config.parent / "run" / "running").note(NAME, EPOCH_MAX - 1)
    assert main(["mend", NAME, "--epoch", "12", "--yes", "--config", str(config)]) == 1
    assert "runs at robot1" in capsys.readouterr().err and records(config) == (POISONED, OTHER)
