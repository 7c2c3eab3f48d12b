"""``failover-agent recover``: fetches a component from the archive into this robot's store, while its agent is stopped.

For the day on which no robot of the team holds it: the next agent knows it as a component of which this robot holds the newest
checkpoint, and which no robot runs.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import msgspec

from agent.config import Settings
from agent.core_config import fetches, retention
from agent.errors import AgentError
from agent.main_loop.vote_record import VoteRecordFile
from agent.mend import check_agent_stopped, check_right, check_stopped
from agent.worker.replication.receive_files import is_in_place
from checkpoint.errors import UNDECODABLE, CheckpointError
from checkpoint.sentences import in_words
from checkpoint.snapshot import format
from checkpoint.snapshot.required_files import needs
from checkpoint.store.contract import SnapshotStore
from checkpoint.store.store import open_store
from failover.archive import sealed
from failover.archive.archive import Archive, Copy, Label, object_store
from failover.archive.objects import ObjectStore
from failover.archive.witness import WitnessObjects
from failover.core import vote_record as core_vote_record
from failover.core.types import ComponentSpec, Record, State, VoteRecord


def recover(settings: Settings, name: str) -> int:
    """Fetch the newest copy of a component, with its files, and put it on record here.

    Raises:
        AgentError: the agent runs; the component is on record here; this member keeps no checkpoints, or names no archive.
        FailoverError: the archive does not have it, or does not give it whole.
    """
    directory, config = Path(settings.config.state_directory), settings.config.store
    if not config.place:
        raise AgentError(f'{settings.path} names no archive; write s3 = "s3://BUCKET/PREFIX", or witness = "NAME", into [store]')
    if settings.me.role == "witness":
        raise AgentError(f"{settings.config.robot} is a witness, and keeps no checkpoints; recover {name} at a robot")
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)  # no agent may have run here yet
    except OSError as error:
        raise AgentError(f"cannot make the state directory {directory}: {error.strerror}") from error
    check_right(directory)
    key = sealed.read_key(Path(settings.config.team_directory))
    with _objects(settings, key) as objects:
        archive = Archive(objects, key, settings.team.team, directory, by_epoch=fetches(settings))
        return _recover(settings, name, archive, directory)


@contextlib.contextmanager
def _objects(settings: Settings, key: bytes) -> Iterator[ObjectStore]:
    """Where the copies are."""
    config = settings.config.store
    if not config.witness:
        yield object_store(config.s3, config.s3_endpoint)
        return
    from agent.visit import visiting  # here: only then a connection is needed

    check_agent_stopped(settings)
    with visiting(settings) as witness:
        yield WitnessObjects(witness, key)


def _recover(settings: Settings, name: str, archive: Archive, directory: Path) -> int:
    copies = archive.named(name)
    if not copies:
        raise AgentError(
            f"the archive {settings.config.store.place} has no checkpoint of {name}; failover archive list shows those there are"
        )
    record_file = VoteRecordFile(directory, settings.config.robot)
    before = core_vote_record.decode(record_file.read().core)
    try:
        with (
            contextlib.closing(open_store(directory / "store", None, retention(settings.config))) as store,
            tempfile.TemporaryFile(dir=directory) as file,
        ):
            component, label = _fetched(archive, copies[0], file, before, settings)
            spec = _spec(label)
            missing = _keep_files(archive, store, file, directory)
            store.put(file.fileno())
    except (CheckpointError, OSError) as error:
        raise AgentError(f"cannot recover {name}: {in_words(error)}; nothing is on record of it") from error
    record = Record(component, copies[0].epoch, state=State.STANDBY, spec=spec, begun=True)
    record_file.keep(core_vote_record.encode(msgspec.structs.replace(before, records=(*before.records, record))))
    robot, epoch = settings.config.robot, copies[0].epoch
    print(f"{robot} holds {component} as {label.robot} archived it, epoch {epoch}; start the agent, and see failover status")
    for path in missing:
        print(f"{component} needs {path}, which is neither here nor whole in the archive: install it before it goes on here")
    return 0


def _fetched(archive: Archive, copy: Copy, file: BinaryIO, before: VoteRecord, settings: Settings) -> tuple[str, Label]:
    """Have the checkpoint in a file; its component, whose name the object may have cut, and its label."""
    label = archive.fetch(copy, file)
    component = format.read_header(file.fileno()).component
    check_stopped(settings, component)
    if any(one.name == component for one in before.records):
        raise AgentError(
            f"{component} is on record at {settings.config.robot}: its team knows it; start the agent and see failover status, "
            "or failover release it first"
        )
    return component, label


def _keep_files(archive: Archive, store: SnapshotStore, checkpoint: BinaryIO, directory: Path) -> list[str]:
    """Bring the files that the program needs and that this robot lacks; answers with those that are not whole in the archive."""
    missing = []
    for need in needs(format.read_outline(checkpoint.fileno())):
        if not need.digest or is_in_place(need) or store.contents.has(need.digest, need.size):
            continue
        if not archive.holds_whole(need.digest):
            missing.append(need.path)
            continue
        with tempfile.TemporaryFile(dir=directory) as file:
            archive.fetch_content(need, file)
            store.contents.put(file.fileno(), need.digest)
    return missing


def _spec(label: Label) -> ComponentSpec | None:
    try:
        return msgspec.msgpack.decode(label.spec, type=ComponentSpec) if label.spec else None
    except UNDECODABLE as error:
        raise AgentError(f"the archive has a specification that this version of failover cannot read: {error}") from error
