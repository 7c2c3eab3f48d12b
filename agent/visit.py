"""A conversation with one witness while this robot's agent is stopped: its replication link is ours for that time.

An answer travels on the connection that the other side makes to this robot. So this robot listens where its agent would, and asks
once the witness has greeted. A witness takes no heartbeat and counts no vote from here: nothing of this greets it.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterator
from typing import Any, Final

from agent.config import Settings
from agent.errors import AgentError, LaneError
from agent.worker.network.connections import keys_of
from agent.worker.network.remote_orders import SEALED, Errands
from agent.worker.network.replication_link import Callbacks, LinkState, ReplicationLink
from failover.core.wire.messages import Bulk, ErrandDone, Hello
from failover.errors import ArchiveError

GREETING_S: Final = 30.0
"""How long a witness may take to connect: it tries each 2 s at least."""


class Visit:
    """The way to the witness, as `failover.archive.witness.Witness` says; it fetches, and puts nothing."""

    def __init__(self, loop: asyncio.AbstractEventLoop, errands: Errands, witness: str) -> None:
        self._loop, self._errands, self._witness = loop, errands, witness

    def ask(self, arguments: dict[str, Any]) -> dict[str, Any]:
        """See `failover.archive.witness.Witness.ask`."""
        try:
            return self._loop.run_until_complete(self._errands.send(self._witness, SEALED, arguments))
        except AgentError as error:
            raise ArchiveError(f"the witness does not give its sealed copies: {error}") from error

    def ship(self, digest: bytes, size: int, descriptor: int) -> None:
        """See `failover.archive.witness.Witness.ship`."""
        raise ArchiveError("nothing is put while the agent is stopped")


@contextlib.contextmanager
def visiting(settings: Settings) -> Iterator[Visit]:
    """Be connected with the witness of ``[store]``.

    Raises:
        ArchiveError: it does not answer; LaneError: the address of this robot's agent cannot be had.
    """
    witness = settings.config.store.witness
    with contextlib.closing(asyncio.new_event_loop()) as loop:
        link, errands = loop.run_until_complete(_connected(settings, witness))
        try:
            yield Visit(loop, errands, witness)
        finally:
            loop.run_until_complete(link.close())


async def _connected(settings: Settings, witness: str) -> tuple[ReplicationLink, Errands]:
    greeted, stands, states = asyncio.Event(), asyncio.Event(), [""]

    def hear(peer: str, message: Bulk) -> None:
        if isinstance(message, Hello):
            greeted.set()
        elif isinstance(message, ErrandDone):
            errands.done(peer, message)

    def change(peer: str, state: LinkState, reason: str) -> None:
        states[0] = f"{state}, {reason}" if reason else str(state)
        if state is LinkState.CONNECTED:
            stands.set()
        else:
            stands.clear()
            errands.lost(peer)

    peers = {witness: settings.team.robots[witness].bulk}
    link = ReplicationLink(settings.config.robot, settings.me.bulk, peers, keys_of(settings), Callbacks(hear, change))
    errands = Errands(link.say, lambda _: "" if stands.is_set() else states[0], {})
    try:
        link.open()
        async with asyncio.timeout(GREETING_S):
            await stands.wait()
            await greeted.wait()
    except TimeoutError as error:
        await link.close()
        raise ArchiveError(
            f"witness {witness} at {peers[witness]} did not greet within {GREETING_S:.0f} s ({states[0] or 'no connection'}); "
            "see that its agent runs and reaches this robot"
        ) from error
    except LaneError:
        await link.close()
        raise
    return link, errands
