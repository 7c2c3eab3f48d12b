"""``failover-agent recover``: fetches a component from the archive into this robot's store, while its agent is stopped.

For the day on which no robot of the team holds it: the next agent knows it as a component of which this robot holds the newest
checkpoint, and which no robot runs.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final

import msgspec

from agent.config import Settings
from agent.core_config import fetches, retention
from agent.errors import AgentError
from agent.main_loop.vote_record import VoteRecordFile
from agent.mend import check_agent_stopped, check_right, check_stopped
from agent.system.last_alive import FILE_NAME as LAST_ALIVE
from agent.worker.replication.receive_files import is_in_place
from checkpoint.errors import UNDECODABLE, CheckpointError
from checkpoint.keeper.messages import close_all
from checkpoint.sentences import in_words
from checkpoint.snapshot import format
from checkpoint.snapshot.required_files import needs
from checkpoint.store.contract import SnapshotStore
from checkpoint.store.store import open_store
from failover.archive.archive import Archive, Copy, Label, object_store
from failover.archive.keys import read_keys, recovery_path
from failover.archive.objects import ObjectStore
from failover.archive.witness import WitnessObjects
from failover.core import vote_record as core_vote_record
from failover.core.types import SPAN, ComponentSpec, Record, State, VoteRecord
from failover.errors import ArchiveError

TRIES: Final = 5
"""To have the newest copy, where newer ones come meanwhile."""


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
    keys = read_keys(Path(settings.config.team_directory), settings.team)
    with _objects(settings, keys.shared) as objects:
        archive = Archive(objects, keys, settings.team.team, directory, by_epoch=fetches(settings))
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
    record_file = VoteRecordFile(directory, settings.config.robot)
    before = core_vote_record.decode(record_file.read().core)
    try:
        with (
            contextlib.closing(open_store(directory / "store", None, retention(settings.config))) as store,
            tempfile.TemporaryFile(dir=directory) as file,
        ):
            copy, label = _newest(settings, name, archive, file)
            component = _checked(file, before, settings)
            epoch = _epoch(settings, component, label, copy, before)
            spec = _spec(label)
            missing = _keep_files(archive, store, file, directory)
            store.put(file.fileno())
            _date(store, component, label, directory)
    except (CheckpointError, OSError) as error:
        raise AgentError(f"cannot recover {name}: {in_words(error)}; nothing is on record of it") from error
    record = Record(component, epoch, state=State.STANDBY, spec=spec, begun=True)
    others = (one for one in before.records if one.name != component)
    record_file.keep(core_vote_record.encode(msgspec.structs.replace(before, records=(*others, record))))
    robot = settings.config.robot
    print(f"{robot} holds {component} as {label.robot} archived it, epoch {epoch}; start the agent, and see failover status")
    age_s = max(time.time() - label.at_s, 0)
    print(f"this copy was sealed at {_instant(label)}, {age_s:.0f} s ago by the clock of {robot}: the work since then is lost")
    if (recovery := recovery_path(Path(settings.config.team_directory))).exists():
        print(f"{recovery} opens every copy: move it to where no robot is again")
    for path in missing:
        print(f"{component} needs {path}, which is neither here nor whole in the archive: install it before it goes on here")
    return 0


def _newest(settings: Settings, name: str, archive: Archive, file: BinaryIO) -> tuple[Copy, Label]:
    """Have the newest checkpoint in a file. Where the component runs, newer copies take the place of older ones meanwhile."""
    for _ in range(TRIES):
        copies = archive.named(name)
        if not copies:
            place = settings.config.store.place
            raise AgentError(f"the archive {place} has no checkpoint of {name}; failover archive list shows those there are")
        file.seek(0)
        file.truncate()
        try:
            return copies[0], archive.fetch(copies[0], file)
        except ArchiveError:
            if copies[0] in archive.named(name):
                raise
    raise AgentError(
        f"{TRIES} times the newest copy of {name} was removed before it was here: {name} runs, and newer copies came; stop it "
        "first (failover stop), or set a larger s3_keep where it runs"
    )


def _checked(file: BinaryIO, before: VoteRecord, settings: Settings) -> str:
    """The component, whose name the object may have cut; it may be recovered here."""
    component = format.read_header(file.fileno()).component
    check_stopped(settings, component)
    if (known := _known(before, component)) is not None and not known.is_elsewhere:
        raise AgentError(
            f"{component} is on record at {settings.config.robot}: its team knows it; start the agent and see failover status, "
            "or failover release it first"
        )
    return component


def _known(before: VoteRecord, component: str) -> Record | None:
    return next((one for one in before.records if one.name == component), None)


def _epoch(settings: Settings, component: str, label: Label, copy: Copy, before: VoteRecord) -> int:
    """The epoch to have on record: the first of the next span, unless a member of this site made the copy.

    Another site may have claimed later epochs than the copy's since: also that of a robot that is no member any more. See
    `failover.core.election.sites`.
    """
    known = _known(before, component)
    if known is None and label.robot in settings.near:
        return copy.epoch
    return (max(copy.epoch, known.epoch if known is not None else 0) // SPAN + 1) * SPAN


def _date(store: SnapshotStore, component: str, label: Label, directory: Path) -> None:
    """Let the checkpoint's file be as old as the state in it: by that the agent tells how much work is lost.

    For how long this robot was off says nothing of a program that ran elsewhere: its sign of life goes.
    """
    at_ns = int(label.at_s * 1e9)
    chain = tuple(store.open_chain(component))
    try:
        os.utime(chain[-1], ns=(at_ns, at_ns))
    finally:
        close_all(chain)
    (directory / LAST_ALIVE).unlink(missing_ok=True)


def _instant(label: Label) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(label.at_s))


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
