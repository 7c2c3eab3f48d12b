"""This robot replaces its key, by two changes of the team, or goes on where that was broken off.

The rule is `failover.core.team_changes.rotation`. Loaded when it is wanted: an agent that replaces no key does not carry it.
"""

from __future__ import annotations

import asyncio
import functools
import logging
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, Protocol

from agent.config import Settings
from agent.errors import AgentError, LaneError, RefusedError
from agent.worker.network.replication_link import new_keys, public_key_of, shown
from failover.config import members
from failover.config import team as team_file
from failover.config.team import Team
from failover.core.team_changes import TWO_KEYS, rotation
from failover.errors import FailoverError

log = logging.getLogger("failover.lanes")


Prepare = Callable[[], Awaitable[None]]
"""What this robot does once all have granted its change, before any has it."""


class Changes(Protocol):
    """What of `agent.worker.team_changes.TeamChanges` is needed here."""

    def check_that_it_can_be_written(self) -> None: ...
    async def agreed(self, before: Team, after: Team, removed: str = "", prepare: Prepare | None = None) -> dict[str, Any]: ...
    async def until_reached(self, peer: str) -> None: ...


class Lines(Protocol):
    """What of `agent.worker.hub.Switchboard` is needed here."""

    settings: Settings

    def hindrance(self, peer: str) -> str: ...
    async def take_secret(self, secret: str) -> None: ...


class KeyRotation:
    """One of them. Lives in the worker's loop."""

    def __init__(self, changes: Changes, lines: Lines) -> None:
        self._changes, self._lines = changes, lines
        self._me = lines.settings.config.robot
        self._directory = Path(lines.settings.config.team_directory)

    async def run(self) -> dict[str, Any]:
        """As `failover.client.control` says of the verb ``team``.

        Raises:
            RefusedError: a member is away or refuses, or the key's files cannot be used; what counts until then is said.
        """
        own = self._lines.settings.me
        if self._lines.settings.config.insecure:
            raise RefusedError("this robot runs without keys (insecure = true): there is none to replace")
        if own.role == "witness":
            raise RefusedError(
                f"{self._me} is a witness, whose word changes no team: at a robot, failover team remove {self._me}, then invite "
                f"{self._me} again"
            )
        self._changes.check_that_it_can_be_written()
        in_use = await self._in_use()
        secret = await asyncio.to_thread(team_file.read_next_key, self._directory, self._me)
        prepared = _public_half(secret)
        stage = rotation((own.public_key, own.next_key), in_use, prepared)
        if stage == "unfit":
            raise RefusedError(
                f"the secret key of {self._me} does not belong to its public key in the team; see failover-agent check"
            )
        if stage == "undo":
            await self._agreed(in_use)
        if stage in ("begin", "undo"):
            prepared, secret = new_keys()
            await asyncio.to_thread(_kept, team_file.write_next_key, self._directory, self._me, secret)
            await self._agreed(in_use, prepared)
        kept = in_use if stage == "finish" else prepared
        try:
            answer = await self._agreed(kept, prepare=None if stage == "finish" else functools.partial(self._switch, secret))
        except (FailoverError, AgentError) as error:
            raise RefusedError(f"{error}; {TWO_KEYS.format(robot=self._me)}") from error
        log.info("%s has another key: %s in the place of %s", self._me, shown(kept), shown(own.public_key))
        return answer | {"robot": self._me, "public_key": kept}

    async def _in_use(self) -> str:
        """The public half of this robot's key. Where the disk has another one than this agent uses, the disk's counts.

        That is so after a disk said that it could not write, and had written.
        """
        settings = self._lines.settings
        secret = await asyncio.to_thread(team_file.read_secret_key, self._directory, self._me)
        public = _public_half(secret)
        if secret != settings.secret_key and public in settings.me.keys:
            await self._lines.take_secret(secret)
        return public

    async def _agreed(self, key: str, following: str = "", prepare: Prepare | None = None) -> dict[str, Any]:
        """Have all agree to these keys of this robot; ``following``: "" for ``key`` alone."""
        before, me = self._lines.settings.team, self._me
        after = members.with_next_key(before, me, following) if following else members.with_one_key(before, me, key)
        return await self._changes.agreed(before, after, prepare=prepare)

    async def _switch(self, secret: str) -> None:
        """Use the new key. All members have it beside the old one: they have granted the next change.

        Raises:
            RefusedError: the file cannot be written, or a member is not reached with the new key.
        """
        reached = [peer for peer in self._lines.settings.others if not self._lines.hindrance(peer)]
        await asyncio.to_thread(_kept, team_file.use_next_key, self._directory, self._me)
        await self._lines.take_secret(secret)
        for peer in reached:
            await self._changes.until_reached(peer)
            if hindrance := self._lines.hindrance(peer):
                raise RefusedError(f"{peer} is not reached with it: {hindrance}")


def _kept(write: Callable[..., None], directory: Path, *rest: str) -> None:
    """Raises RefusedError: the key's file cannot be written; nothing has changed."""
    try:
        write(directory, *rest)
    except OSError as error:
        raise RefusedError(
            f"cannot write below {directory / 'keys'}: {error.strerror}; a service needs ReadWritePaths={directory}"
        ) from error


def _public_half(secret: str) -> str:
    """The public key of a secret one; "" where it is none."""
    try:
        return public_key_of(secret) if secret else ""
    except LaneError:
        return ""
