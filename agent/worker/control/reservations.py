"""This robot's reservations: begun and ended by users, told to the other robots, kept through a restart of the agent.

The rule is `failover.core.reservations`. Instants in the file are of CLOCK_BOOTTIME, so a reboot of the robot forgets them; the
others tell it again.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import time
from collections.abc import Awaitable, Callable, Iterable
from pathlib import Path
from typing import Any, Final

import msgspec

from agent.errors import TROUBLE, RefusedError
from agent.system import clock
from agent.worker.network.remote_orders import Errands
from checkpoint.store.whole_file import write_whole
from failover.config import accounts
from failover.core.reservations import RESERVATIONS_MAX, WHY_SIZE_MAX, Reservation, Table, Told, covering, reserved_path, telling
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

    reservations: tuple[Told, ...]


class Reservations:
    """The table of this robot."""

    def __init__(self, state: Path, errands: Callable[[], Errands], reachable: Callable[[], Awaitable[list[str]]]) -> None:
        """
        Args:
            reachable: the robots that can be asked now.
        """
        self._path, self._errands, self._reachable = state / FILE, errands, reachable
        self._table = Table(self._kept())

    def _kept(self) -> tuple[Reservation, ...]:
        try:
            kept = msgspec.msgpack.decode(self._path.read_bytes(), type=Kept)
        except (OSError, msgspec.DecodeError):
            return ()
        return kept.reservations[:RESERVATIONS_MAX] if kept.boot_id == clock.kernel_boot() else ()

    # --- What is asked of it -------------------------------------------------------------------------------------------

    def refusal(self, uid: int, path: str) -> str:
        """Why a user may give no order about a path; "" if no other user has reserved it."""
        try:
            found = self._table.hinders(uid, path, clock.now_ns())
        except RightsError:
            return ""  # what is no path cannot be reserved
        return "" if found is None else f"{found.path} is {_told(found)}; ask {found.user}, or wait until then"

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
        now_ns = clock.now_ns()
        user = await _name_of(uid)
        wanted = Reservation(secrets.token_hex(8), path, uid, user, why, now_ns, now_ns + span_ms * MS)
        hindrance = self._table.why_not(wanted, now_ns)
        if isinstance(hindrance, Reservation):
            raise RefusedError(f"cannot reserve {path}: {hindrance.path} is {_told(hindrance)}", "PermissionError")
        if hindrance:
            raise RefusedError(hindrance)
        changed = self._table.begin(wanted, now_ns)
        log.info("%s has reserved %s for %s: %s", user, path, _span(span_ms), why or "no reason given")
        return await self._spread(changed, f"{path} is {_told(wanted)}") | {"path": path, "left_ms": span_ms}

    async def end(self, path: str, uid: int, breaks: bool, may_break: Callable[[str], Awaitable[str]]) -> dict[str, Any]:
        """End the reservation in which a path is.

        Args:
            breaks: also another user's. may_break: why this user may not, asked for the path that is reserved.

        Raises:
            RefusedError: there is none, or it is another user's.
        """
        try:
            found = self._table.over_path(path, clock.now_ns())
        except RightsError as error:
            raise RefusedError(str(error), "RightsError") from error
        if found is None:
            raise RefusedError(f"{path} is not reserved")
        user, sentence = await _name_of(uid), f"{found.path} is free again"
        if found.uid != uid:
            refusal = await may_break(found.path) if breaks else "with --break root may end it, and who has the right grant there"
            if refusal:
                raise RefusedError(f"{found.path} is {_told(found)}; {refusal}", "PermissionError")
            sentence += f": {user} has broken the reservation of {found.user}"
        log.info("%s (by %s)", sentence, user)
        return await self._spread((self._table.end(found),), sentence) | {"path": found.path, "user": found.user}

    async def _spread(self, changed: tuple[Reservation, ...], sentence: str) -> dict[str, Any]:
        """Keep it, and tell the others."""
        await self._keep()
        peers = await self._reachable()
        heard = await asyncio.gather(*(self._tell(peer, changed) for peer in peers))
        return {"sentence": sentence, "untold": [peer for peer, has in zip(peers, heard, strict=True) if not has]}

    async def _keep(self) -> None:
        kept = Kept(clock.kernel_boot(), self._table.all(clock.now_ns()))
        try:
            await asyncio.to_thread(write_whole, self._path, msgspec.msgpack.encode(kept))
        except OSError as error:
            log.warning("reservations do not outlive this agent: %s: %s", self._path, error.strerror)

    # --- Between robots ------------------------------------------------------------------------------------------------

    async def hear(self, arguments: dict[str, Any], _by: int) -> dict[str, Any]:
        """Another robot tells what it knows.

        Raises:
            RefusedError: it is nothing that a robot of this version tells.
        """
        try:
            told = msgspec.convert(arguments, Hearing).reservations
        except msgspec.ValidationError as error:
            raise RefusedError(f"reservations were not understood: {error}; the robots are of different versions") from error
        now_ns = clock.now_ns()
        if [one for one in told[:RESERVATIONS_MAX] if self._table.hear(one, now_ns)]:
            await self._keep()
        return {}

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
        now_ns = clock.now_ns()
        told = msgspec.to_builtins(Hearing(tuple(telling(one, now_ns) for one in some)))
        try:
            await self._errands().send(peer, "reservations", told, patience_s=PATIENCE_S)
        except RefusedError:
            return False
        return True


def checked_reason(why: str) -> str:
    """Raises RefusedError: it is no reason of one line."""
    if len(why) > WHY_SIZE_MAX or not why.isprintable():
        raise RefusedError(f"a reason is one line of at most {WHY_SIZE_MAX} characters")
    return why


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
