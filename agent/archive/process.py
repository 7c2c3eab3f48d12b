"""The archive's process: folds, seals, sends and proves what the worker gives it, one thing at a time. Ends when the worker does.

Started as `python -P -m agent.archive.process CONFIG DESCRIPTOR`, with all modules of Python: the library for S3 needs some that
`agent.system.child_main` leaves out. It yields to everything else on the robot, and the kernel takes its memory first.
"""

from __future__ import annotations

import contextlib
import os
import socket
import sys
from pathlib import Path
from typing import Any, Final

import msgspec

from agent import config as configuration
from agent.archive.messages import (
    Carried,
    Carry,
    Done,
    Fetch,
    FetchContent,
    KeepCheckpoint,
    KeepContent,
    ListCopies,
    Look,
    Request,
)
from agent.config import Settings
from agent.core_config import fetches
from agent.errors import AgentError
from agent.main_loop.vote_record import VoteRecordFile
from checkpoint.errors import CheckpointError
from checkpoint.keeper.messages import Channel, ChannelError, close_all
from checkpoint.sentences import in_words
from checkpoint.store.chain_files import folded_in_steps
from failover.archive.archive import Archive, Last, object_store
from failover.archive.keys import read_keys
from failover.archive.objects import require_room
from failover.archive.witness import Witness, WitnessObjects
from failover.config.team import read as read_team
from failover.core import vote_record
from failover.errors import ArchiveError, FailoverError

NICE: Final = 10
"""A tenth of what an ordinary process gets where both want the processor: it yields, and still comes on where all are busy."""

OOM_SCORE: Final = "800"


class ByWorker:
    """The way to the witness, as `failover.archive.witness.Witness` says: the worker has the link, and the credit on it."""

    def __init__(self, channel: Channel[Request | Carried]) -> None:
        self._channel = channel

    def ask(self, arguments: dict[str, Any]) -> dict[str, Any]:
        """See `failover.archive.witness.Witness.ask`."""
        answer: dict[str, Any] = msgspec.msgpack.decode(self._carried(Carry(msgspec.msgpack.encode(arguments))))
        return answer

    def ship(self, digest: bytes, size: int, descriptor: int) -> None:
        """See `failover.archive.witness.Witness.ship`."""
        self._carried(Carry(digest=digest, size=size), (descriptor,))

    def _carried(self, carry: Carry, descriptors: tuple[int, ...] = ()) -> bytes:
        self._channel.send(carry, descriptors)
        answer, _ = self._channel.receive()
        assert isinstance(answer, Carried), "the worker asks one thing after the other"
        if answer.refusal:
            raise ArchiveError(answer.refusal)
        return answer.answer


class Archivist:
    """Carries requests out. The place, the members and all keys are looked for at each: they may come later, and change."""

    def __init__(self, settings: Settings, witness: Witness | None = None) -> None:
        self._settings = settings
        self._witness = witness
        self._aside = Path(settings.config.state_directory)
        self._last: dict[str, Last] = {}

    def answer(self, request: Request, descriptors: tuple[int, ...]) -> Done:
        """Do what is asked, or say why it cannot be done."""
        try:
            return self._done(request, descriptors)
        except (CheckpointError, FailoverError, AgentError) as error:
            return Done(refusal=str(error))
        except OSError as error:
            return Done(refusal=f"the archive's process cannot write below {self._aside}: {in_words(error)}")

    def _done(self, request: Request, descriptors: tuple[int, ...]) -> Done:
        archive = self._opened()
        match request:
            case Look():
                return Done(lacking=tuple(digest for digest in request.digests if not archive.holds_for_all(digest)))
            case KeepContent():
                with open(descriptors[0], "rb", buffering=0, closefd=False) as content:
                    return Done(size=archive.put_content(request.digest, content))
            case KeepCheckpoint():
                size = sum(os.fstat(one).st_size for one in descriptors)
                require_room(self._aside, 2 * size)  # folded, and sealed or folded again
                with folded_in_steps(descriptors, self._aside) as checkpoint:
                    name, put_size = archive.put(checkpoint, self._settings.config.robot, self._spec(request.component))
                archive.thin(request.component, self._settings.config.store.s3_keep, but=name)
                return Done(name=name, size=put_size)
            case ListCopies():
                return Done(copies=tuple(archive.copies()))
            case Fetch(copy):
                require_room(self._aside, copy.size)
                with open(descriptors[0], "wb", buffering=0, closefd=False) as file:
                    return Done(label=archive.fetch(copy, file))
            case FetchContent(need):
                require_room(self._aside, need.size)
                with open(descriptors[0], "wb", buffering=0, closefd=False) as file:
                    archive.fetch_content(need, file)
                return Done()

    def _opened(self) -> Archive:
        store, directory = self._settings.config.store, Path(self._settings.config.team_directory)
        team = read_team(directory)
        keys = read_keys(directory, team)
        witness = self._witness
        objects = WitnessObjects(witness, keys.shared) if witness is not None else object_store(store.s3, store.s3_endpoint)
        return Archive(objects, keys, team.team, self._aside, by_epoch=fetches(self._settings), last=self._last)

    def _spec(self, component: str) -> bytes:
        """How a component is started and by which rules it lives, as this member has it on record."""
        directory, robot = Path(self._settings.config.state_directory), self._settings.config.robot
        records = vote_record.decode(VoteRecordFile(directory, robot).read().core).records
        spec = next((one.spec for one in records if one.name == component), None)
        return msgspec.msgpack.encode(spec) if spec is not None else b""


def main() -> int:
    """Answer until the worker has gone."""
    path, descriptor = sys.argv[1:3]
    channel: Channel[Request | Carried] = Channel(socket.socket(fileno=int(descriptor)), Request | Carried)
    os.nice(NICE)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(OOM_SCORE)
    try:
        settings = configuration.load(Path(path))
    except AgentError as error:
        print(f"failover archive: {error}", file=sys.stderr)
        return 1
    archivist = Archivist(settings, ByWorker(channel) if settings.config.store.witness else None)
    while True:
        try:
            request, descriptors = channel.receive()
            assert not isinstance(request, Carried), "nothing is being carried"
            try:
                channel.send(archivist.answer(request, descriptors))
            finally:
                close_all(descriptors)
        except (ChannelError, KeyboardInterrupt):
            return 0


if __name__ == "__main__":
    sys.exit(main())
