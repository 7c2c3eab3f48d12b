"""This robot's reservations: begun and ended by users, told to the other robots, kept through a restart of the agent.

The rule is `failover.core.reservations`. Instants in the file are of CLOCK_BOOTTIME, so a reboot of the robot forgets them; the
others tell it again.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import secrets
import shlex
import time
from collections.abc import Awaitable, Callable, Iterable
from pathlib import Path
from typing import Any, Final

import msgspec

from agent.errors import TROUBLE, RefusedError
from agent.system import clock
from agent.system.permissions import ROOT, may
from agent.worker.network.remote_orders import Errands
from checkpoint.errors import UNDECODABLE
from checkpoint.store.whole_file import write_whole
from failover.config import accounts
from failover.core.reservations import (
    KNOWN_MAX,
    WHY_SIZE_MAX,
    Reservation,
    Table,
    Told,
    at_or_below,
    covering,
    id_of,
    reserved_path,
    telling,
)
from failover.core.types import MS
from failover.errors import RightsError

FILE: Final = "reservations"

TELL_AGAIN_S: Final = 5.0
"""Between two times that each robot tells the others what it knows: one that was away learns it."""

PATIENCE_S: Final = 2.0
"""How long another robot may take to hear of it: one that is slow learns it later."""

log = logging.getLogger("failover.lanes")


class Kept(msgspec.Struct, frozen=True):
    """What the file holds."""

    boot_id: str
    reservations: tuple[Reservation, ...] = ()


class Hearing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What another robot tells."""

    reservations: tuple[Told, ...] = ()


class Reservations:
    """The table of this robot."""

    def __init__(self, state: Path, errands: Callable[[], Errands], reachable: Callable[[], Awaitable[list[str]]]) -> None:
        """
        Args:
            reachable: the robots that can be asked now.
        """
        self._path, self._errands, self._reachable = state / FILE, errands, reachable
        self._table = Table(self._kept(), frozenset({ROOT, os.geteuid()}))
        self._keeping = asyncio.Lock()

    def _kept(self) -> tuple[Reservation, ...]:
        try:
            kept = msgspec.msgpack.decode(self._path.read_bytes(), type=Kept)
        except (OSError, *UNDECODABLE):
            return ()
        return kept.reservations if kept.boot_id == clock.kernel_boot() else ()

    # --- What is asked of it -------------------------------------------------------------------------------------------

    def refusal(self, uid: int, path: str) -> str:
        """Why a user may give no order about a path; "" if no other user has reserved it."""
        try:
            found = self._table.hinders(uid, path, clock.now_ns())
        except RightsError:
            return ""  # what is no path cannot be reserved
        if found is None:
            return ""
        cure = f", or end it with failover unreserve {shlex.quote(found.path)} --break" if may(uid, None) else ""
        return f"{found.path} is {_told(found)}; ask {found.user}, or wait until then{cure}"

    def check(self, uid: int, paths: Iterable[str]) -> None:
        """Let a user give an order about these.

        Raises:
            RefusedError: another user has reserved one of them; names who, and until when.
        """
        for path in paths:
            if refusal := self.refusal(uid, path):
                raise RefusedError(refusal, "PermissionError")

    def show(self, picture: dict[str, Any]) -> None:
        """Add to a status what stands."""
        now_ns = clock.now_ns()
        standing = self._table.standing(now_ns)
        picture["reservations"] = [_shown(one, now_ns) for one in standing]
        for component in picture["components"] if standing else ():
            with contextlib.suppress(RightsError):
                if found := covering(standing, component["name"]):
                    component["reserved"] = _shown(found, now_ns)

    # --- Beginning and end ---------------------------------------------------------------------------------------------

    async def begin(self, path: str, uid: int, span_ms: int, why: str) -> dict[str, Any]:
        """Reserve a path. The user's right to it was checked.

        Raises:
            RefusedError: another user has reserved it, or part of it; it is no path; there are too many.
        """
        try:
            path = reserved_path(path)
        except RightsError as error:
            raise RefusedError(str(error), "RightsError") from error
        user = await _name_of(uid)
        now_ns = clock.now_ns()
        wanted = Reservation(id_of(time.time_ns(), secrets.token_hex(4)), path, uid, user, why, now_ns + span_ms * MS)
        hindrance = self._table.why_not(wanted, now_ns)
        if isinstance(hindrance, Reservation):
            raise _is_anothers(path, hindrance)
        if hindrance:
            raise RefusedError(hindrance)
        answer = await self._spread(self._table.begin(wanted, now_ns), f"{path} is {_told(wanted)}")
        hindrance = self._table.why_not(wanted, clock.now_ns())
        if isinstance(hindrance, Reservation):  # another robot granted it at the same time, before it heard of this one
            await self._spread((self._table.end(wanted),), "")
            raise _is_anothers(path, hindrance)
        log.info("%s has reserved %s for %s: %s", user, path, _span(span_ms), why or "no reason given")
        return answer | {"path": path, "left_ms": span_ms}

    async def end(self, path: str, uid: int, breaks: bool, may_break: Callable[[str], Awaitable[str]]) -> dict[str, Any]:
        """End the reservation in which a path is.

        Args:
            breaks: also another user's; all at and below the path. may_break: why this user may not end one at a path.

        Raises:
            RefusedError: there is none, or it is another user's.
        """
        standing = self._table.standing(clock.now_ns())
        try:
            covers = covering(standing, path)
            found = [one for one in standing if breaks and at_or_below(path, [one.path])]
        except RightsError as error:
            raise RefusedError(str(error), "RightsError") from error
        if not found and covers is not None:
            found = [one for one in standing if one.path == covers.path]
        if not found:
            raise RefusedError(f"{path} is not reserved")
        for one in found:
            refusal = "with --break root may end it, and who has the right grant there"
            if one.uid != uid and (refusal := await may_break(one.path) if breaks else refusal):
                raise RefusedError(f"{one.path} is {_told(one)}; {refusal}", "PermissionError")
        user, paths = await _name_of(uid), list(dict.fromkeys(one.path for one in found))
        others = {one.user for one in found if one.uid != uid}
        sentence = f"{', '.join(paths)} {'is' if len(paths) == 1 else 'are'} free again"
        if others:
            sentence += f": {user} has broken the reservation{'s' * (len(paths) > 1)} of {', '.join(sorted(others))}"
        log.info("%s (by %s)", sentence, user)
        ended = tuple(self._table.end(one) for one in found)
        return await self._spread(ended, sentence) | {"path": found[0].path, "user": found[0].user}

    async def _spread(self, changed: tuple[Reservation, ...], sentence: str) -> dict[str, Any]:
        """Keep it, and tell the others."""
        await self._keep()
        peers = await self._reachable()
        heard = await asyncio.gather(*(self._tell(peer, changed) for peer in peers))
        return {"sentence": sentence, "untold": [peer for peer, has in zip(peers, heard, strict=True) if not has]}

    async def _keep(self) -> None:
        async with self._keeping:
            kept = Kept(clock.kernel_boot(), self._table.all(clock.now_ns()))
            try:
                await asyncio.to_thread(write_whole, self._path, msgspec.msgpack.encode(kept))
            except OSError as error:
                log.warning("reservations do not outlive this agent: %s: %s", self._path, error.strerror)

    # --- Between robots ------------------------------------------------------------------------------------------------

    async def hear(self, arguments: dict[str, Any], _by: int) -> dict[str, Any]:
        """Another robot tells what it knows; what it does not know yet is the answer.

        Raises:
            RefusedError: it is nothing that a robot of this version tells.
        """
        try:
            told = msgspec.convert(arguments, Hearing).reservations
        except msgspec.ValidationError as error:
            raise RefusedError(f"reservations were not understood: {error}; the robots are of different versions") from error
        now_ns = clock.now_ns()
        if [one for one in told[:KNOWN_MAX] if self._table.hear(one, now_ns)]:
            await self._keep()
        said = {(one.id, one.over) for one in told}
        return _as_told(one for one in self._table.all(now_ns) if (one.id, one.over) not in said)

    async def tell_again(self) -> None:
        """Tell all robots again and again, until it is cancelled."""
        while True:
            await asyncio.sleep(TELL_AGAIN_S)
            known = self._table.all(clock.now_ns())
            try:
                if known:
                    await asyncio.gather(*(self._tell(peer, known) for peer in await self._reachable()))
            except TROUBLE as trouble:
                log.warning("the other robots were not told of reservations; this robot tries again: %s", trouble)

    async def _tell(self, peer: str, some: tuple[Reservation, ...]) -> bool:
        """Whether it has heard it."""
        try:
            await self.hear(await self._errands().send(peer, "reservations", _as_told(some), patience_s=PATIENCE_S), ROOT)
        except RefusedError:
            return False
        return True


def checked_reason(why: str) -> str:
    """Raises RefusedError: it is no reason of one line."""
    if len(why) > WHY_SIZE_MAX or not why.isprintable():
        raise RefusedError(f"a reason is one line of at most {WHY_SIZE_MAX} characters")
    return why


def _as_told(some: Iterable[Reservation]) -> dict[str, Any]:
    now_ns = clock.now_ns()
    told: dict[str, Any] = msgspec.to_builtins(Hearing(tuple(telling(one, now_ns) for one in some)))
    return told


def _is_anothers(path: str, other: Reservation) -> RefusedError:
    return RefusedError(f"cannot reserve {path}: {other.path} is {_told(other)}", "PermissionError")


async def _name_of(uid: int) -> str:
    return await asyncio.to_thread(accounts.name_of, uid) or f"uid {uid}"


def _shown(one: Reservation, now_ns: int) -> dict[str, Any]:
    left_ms = max(one.until_ns - now_ns, 0) // MS
    return {"path": one.path, "user": one.user, "why": one.why, "left_ms": left_ms, "until": round(time.time() + left_ms / 1_000)}


def _told(one: Reservation) -> str:
    """By whom, until when by this robot's calendar, and why."""
    until = time.localtime(time.time() + (one.until_ns - clock.now_ns()) / 1e9)
    because = f" ({one.why})" if one.why else ""
    return f"reserved by {one.user} until {time.strftime('%H:%M:%S', until)}{because}"


def _span(span_ms: int) -> str:
    minutes = span_ms / 60_000
    return f"{minutes:.0f} min" if minutes >= 1 else f"{span_ms / 1_000:.0f} s"
