"""``failover-agent mend``: corrects the epoch that this member has on record for a component, while its agent is stopped.

A record whose epoch leaves none above it can neither vote nor claim, and a start of the agent does not help: an agent forgets no
epoch by itself. So an operator who has seen that no copy runs gives the epoch.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Final

from msgspec.structs import replace

from agent.config import Settings
from agent.errors import AgentError
from agent.main_loop.vote_record import VoteRecordFile
from agent.worker.components.run_records import Records
from checkpoint.errors import StoreError
from checkpoint.store.contract import SnapshotStore
from checkpoint.store.store import open_store
from failover.client.control import Control
from failover.core import vote_record as core_vote_record
from failover.core.types import EPOCH_SAID_MAX, PEERS_MAX, Record, State, VoteRecord
from failover.errors import NoAgentError

COSTS: Final = """\
failover-agent: {name}: this member's record has epoch {old}; it would be {new}, with no vote in it. That costs:
  - its vote of a later epoch: if another member counts on it, two copies may run. Stop every copy first (failover status).
  - its checkpoints of later epochs: {lost} of {held} go to its store's aside folder, and no program goes on from them by itself.
  - fencing: a gateway or actuator that has seen a later epoch obeys none up to it. Have it forget that one.
Mend every member that has such a record, to the same epoch, before any agent is started again."""


def mend(settings: Settings, name: str, epoch: int, *, agreed: bool) -> int:
    """Lower one record; without agreement say what that costs and ask.

    Returns:
        The exit status: 1 where nothing was changed.

    Raises:
        AgentError: the agent runs, or the program does; no such record; not ours to change; the store cannot be used, or not to
            the end.
    """
    directory = Path(settings.config.state_directory)
    check_right(directory)
    check_stopped(settings, name)
    record_file = VoteRecordFile(directory, settings.config.robot)
    before = core_vote_record.decode(record_file.read().core)
    record = next((one for one in before.records if one.name == name), None)
    if record is None:
        known = ", ".join(f"{one.name} (epoch {one.epoch})" for one in before.records) or "nothing"
        raise AgentError(f"{settings.config.robot} has no record of {name!r}; it has {known}")
    if not 0 < epoch < record.epoch or epoch > EPOCH_SAID_MAX:
        raise AgentError(f"--epoch {epoch}: {name} has epoch {record.epoch}, and mending gives it a lower one, at least 1")
    try:
        return _mend(settings, record_file, before, record, epoch, agreed=agreed)
    except StoreError as error:
        raise AgentError(
            f"cannot mend {name}: {error}; its record has epoch {record.epoch} still, and checkpoints of later epochs may be set "
            "aside already; once the store can be used, give the command again"
        ) from error


def _mend(
    settings: Settings, record_file: VoteRecordFile, before: VoteRecord, record: Record, epoch: int, *, agreed: bool
) -> int:
    name = record.name
    store = None if settings.me.role == "witness" else open_store(Path(settings.config.state_directory) / "store")
    try:
        later = _later(store, name, epoch)
        held = len(store.positions(name)) if store is not None else 0
        print(COSTS.format(name=name, old=record.epoch, new=epoch, lost=len(later), held=held), file=sys.stderr)
        if not (agreed or _agreed()):
            print("failover-agent: nothing was changed; --yes does it", file=sys.stderr)
            return 1
        if store is not None and later:
            store.set_aside(name, {generation for generation, _ in later})
        mended = _mended(record, epoch, has_left=held > len(later))
        records = tuple(mended if one is record else one for one in before.records)
        record_file.keep(core_vote_record.encode(replace(before, records=records)))
    finally:
        if store is not None:
            store.close()
    print(f"{name} has epoch {epoch} on record at {settings.config.robot}; start the agent when every member is mended")
    return 0


def _mended(record: Record, epoch: int, *, has_left: bool) -> Record:
    """The record that remains: the program and its owner, but no vote, no primary, and no robot entrusted."""
    state = State.STANDBY if has_left else State.ABSENT
    return Record(record.name, epoch, state=state, spec=record.spec, begun=record.begun or has_left)


def _later(store: SnapshotStore | None, name: str, epoch: int) -> list[tuple[int, int]]:
    """Generation and number of the snapshots captured under later epochs."""
    positions = store.positions(name) if store is not None else ()
    return [(one.generation, one.sequence) for one in positions if one.generation // (PEERS_MAX + 1) > epoch]


def check_right(directory: Path) -> None:
    """Root has the right, and a user who runs an agent that is not root's."""
    try:
        owner = directory.stat().st_uid
    except OSError as error:
        raise AgentError(f"cannot use the state directory {directory}: {error.strerror}") from error
    if os.geteuid() not in (0, owner):
        raise AgentError(f"cannot mend a record in {directory}: it belongs to uid {owner}; ask root")


def check_agent_stopped(settings: Settings) -> None:
    """Raises AgentError: it runs."""
    try:
        Control.open(Path(settings.config.runtime_directory) / "control.sock").close()
    except NoAgentError:
        return
    raise AgentError(f"the agent of {settings.config.robot} runs; stop it first")


def check_stopped(settings: Settings, name: str) -> None:
    """Raises AgentError: the agent runs, or the component."""
    check_agent_stopped(settings)
    if Records(Path(settings.config.runtime_directory) / "running").epoch(name):
        raise AgentError(
            f"{name} runs at {settings.config.robot}, or did until it was killed; start the agent and failover release it "
            "(it runs on), or end it, first"
        )


def _agreed() -> bool:
    if not sys.stdin.isatty():
        return False
    print("mend it all the same? [y/N] ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")
