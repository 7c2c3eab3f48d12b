"""Pictures of the team, one feed for each user who looks, however many windows that user has; and the charts' last minutes.

A feed asks the agent on behalf of its user, so the agent's rules decide what is in it. It runs while anyone takes it.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from failover.errors import AgentRefusedError, FailoverError, LostAgentError, NoAgentError
from page.agent_link import AgentLink, ask_once
from page.errors import TurnedAwayError
from page.limits import AWAY_S, CHARTS_MAX, FEEDS_MAX, PERIOD_S, POINTS, STALE_S
from page.picture import Answers, Table, item_path, of_drivers, of_items, of_status, of_tasks
from page.surroundings import Around, Rows, Surroundings, drivers

LOG: Final = logging.getLogger("failover.page")

LOAD: Final = 4
"""A look waits so many times as long as it took before the next one: at most a fifth of the time is spent looking."""

RIGHTS_S: Final = 5.0
"""How long an answer about rights is believed. The agent checks each order itself."""

DECISIONS_ASKED: Final = 512
"""Rights times paths in one question: the agent takes no more."""

OWNERS_S: Final = 1.0
"""How long it is believed which component runs which task."""

FULL_PACE: Final = 4
"""Feeds that get a picture each `PERIOD_S`; with more of them all are slower: at most twenty pictures a second."""

NAMES_S: Final = 5.0
"""Between two questions to the drivers for their names …"""

NO_NAMES_S: Final = 30.0
"""… and where there were none."""

POINT_S: Final = 1.0


class Feed:
    """What one user may see, again and again.

    Attributes:
        uid: on whose behalf the agent is asked; None: this process's own user.
        table: the newest picture; replaced, never changed.
        takers: whom to wake when there is another one.
    """

    def __init__(self, uid: int | None) -> None:
        self.uid = uid
        self.table: Table = {"team": {"away": "the agent has not answered yet"}}
        self.takers: set[asyncio.Event] = set()
        self.task: asyncio.Task[None] | None = None
        self._may = Answers()
        self._at_s = time.monotonic()
        self._asked: tuple[Any, ...] = ()
        self._may_until_s = 0.0

    def show(self, table: Table) -> None:
        """There is another picture."""
        self.table, self._at_s = table, time.monotonic()
        self._wake()

    def show_away(self, why: str) -> None:
        """The agent does not answer; the last picture stays, and says so."""
        self.table = {**self.table, "team": {**self.table["team"], "away": why}}
        self._wake()

    def old_s(self) -> int:
        """The age of the picture; 0 where it is as new as it should be."""
        age_s = time.monotonic() - self._at_s
        return round(age_s) if age_s > STALE_S else 0

    def _wake(self) -> None:
        for taker in self.takers:
            taker.set()

    async def rights(self, link: AgentLink, status: Mapping[str, Any], around: Around, names: Rows) -> Answers:
        """What this user may do with all that there is; asked again after `RIGHTS_S`, or for something new."""
        components = {str(one["name"]): one.get("owner") for one in status["components"]}
        items = [item_path(status["team"], one) for one in around.items]
        callees = [str(one["path"]) for one in names]
        robot = f"/{status['team']}/{status['robot']}"
        asked = (components, items, callees, robot)
        if asked != self._asked or time.monotonic() > self._may_until_s:
            about = await self._answers(link, ("see", "operate"), list(components))
            about["see"] |= (await self._answers(link, ("see",), [robot, *items, *callees]))["see"]
            about |= await self._answers(link, ("read",), items)
            self._may = Answers(**about, **await self._answers(link, ("call",), callees))
            self._asked, self._may_until_s = asked, time.monotonic() + RIGHTS_S
        return self._may

    async def _answers(self, link: AgentLink, rights: Sequence[str], paths: Sequence[str]) -> dict[str, dict[str, str]]:
        found: dict[str, dict[str, str]] = {right: {} for right in rights}
        most = DECISIONS_ASKED // len(rights)
        for begin in range(0, len(paths), most):
            part = paths[begin : begin + most]
            told = await link.ask("may", self.uid, rights=list(rights), paths=list(part))
            for right, answers in told["answers"].items():
                found[right] |= answers
        return found


class Feeds:
    """All of them. Lives in one loop."""

    def __init__(self, socket: Path | None) -> None:
        self._socket = socket
        self._feeds: dict[int | None, Feed] = {}
        self._surroundings = Surroundings()
        self._looking = asyncio.Lock()
        self._around, self._around_s = Around(), 0.0
        self._own: dict[str, Any] | None = None
        self._own_s = 0.0
        self._names: Rows = []
        self._naming: asyncio.Task[None] | None = None
        self._points: dict[str, deque[tuple[float, list[float | None]]]] = {}

    def take(self, uid: int | None, wake: asyncio.Event) -> Feed:
        """The feed of a user; it begins with the first who takes it.

        Raises:
            TurnedAwayError: too many users look already.
        """
        feed = self._feeds.get(uid)
        if feed is None:
            if len(self._feeds) >= FEEDS_MAX:
                raise TurnedAwayError(503, f"{FEEDS_MAX} users look at this page already; ask one of them to close it", 10)
            feed = self._feeds[uid] = Feed(uid)
            feed.task = asyncio.create_task(self._run(feed))
        feed.takers.add(wake)
        if self._naming is None:
            self._naming = asyncio.create_task(self._ask_for_names())
        return feed

    def give_back(self, feed: Feed, wake: asyncio.Event) -> None:
        """A client has gone; with the last one its feed ends."""
        feed.takers.discard(wake)
        if not feed.takers and feed.task is not None:
            feed.task.cancel()
            self._feeds.pop(feed.uid, None)

    async def close(self) -> None:
        """End all."""
        tasks = [feed.task for feed in self._feeds.values() if feed.task is not None]
        tasks += [self._naming] if self._naming is not None else []
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self._surroundings.close()

    async def around(self) -> Around:
        """Board and tasks, with all of them; users who look at once look once.

        Raises:
            NoAgentError, LostAgentError: the agent does not tell which components there are.
        """
        async with self._looking:
            if time.monotonic() - self._around_s >= PERIOD_S / 2:
                looking = asyncio.ensure_future(asyncio.to_thread(self._surroundings.look, await self._own_view()))
                try:
                    self._around = await asyncio.shield(looking)
                except asyncio.CancelledError:
                    await asyncio.wait({looking})  # its thread uses the board, and another one must wait for it
                    raise
                self._around_s = time.monotonic()
            return self._around

    async def _own_view(self) -> dict[str, Any] | None:
        """The status as this process's own user sees it: no user's view tells whose a task is that it must not see."""
        if time.monotonic() - self._own_s >= OWNERS_S:
            try:
                self._own = await ask_once(self._socket, "status")
            except AgentRefusedError:
                self._own = None
            self._own_s = time.monotonic()
        return self._own

    def past(self, key: str) -> list[tuple[float, list[float | None]]]:
        """The points of a chart: age in seconds and values, oldest first."""
        now_s = time.monotonic()
        return [(round(now_s - at_s, 1), values) for at_s, values in self._points.get(key, ())]

    async def _run(self, feed: Feed) -> None:
        """Until it is cancelled: the agent may go and come again."""
        while True:
            try:
                async with await AgentLink.open(self._socket) as link:
                    while True:
                        began_s = time.monotonic()
                        await self._look(feed, link)
                        took_s = time.monotonic() - began_s
                        period_s = PERIOD_S * max(1.0, len(self._feeds) / FULL_PACE)
                        await asyncio.sleep(max(period_s - took_s, LOAD * took_s))
            except (NoAgentError, LostAgentError, AgentRefusedError) as error:
                feed.show_away(str(error))
            except FailoverError as error:  # a question that cannot be asked: of our own making, and told
                feed.show_away(f"this page cannot ask the agent: {error}")
            except Exception:
                LOG.exception("a mistake in the page")
                feed.show_away("a mistake in the page; see its log")
            await asyncio.sleep(AWAY_S)

    async def _look(self, feed: Feed, link: AgentLink) -> None:
        status = await link.ask("status", feed.uid, team=True)
        around, names = await self.around(), self._names
        may = await feed.rights(link, status, around, names)
        table = of_status(status, may)
        table |= of_tasks(around.tasks, status, around.owners, may)
        table |= of_items(around.items, str(status["team"]), may)
        table |= of_drivers(names, may)
        self._note(table)
        feed.show(_kept_where_equal(feed.table, table))

    async def _ask_for_names(self) -> None:
        while True:
            try:
                self._names = await asyncio.to_thread(drivers)
            except Exception:
                LOG.exception("a mistake in the page: it does not know which drivers there are")
            await asyncio.sleep(NAMES_S if self._names else NO_NAMES_S)

    def _note(self, table: Table) -> None:
        """A point a second for each chart."""
        now_s = time.monotonic()
        for key, fields in table.items():
            values = charted(key, fields)
            if values is None:
                continue
            points = self._points.get(key)
            if points is None:
                if len(self._points) >= CHARTS_MAX:
                    oldest = min(self._points, key=lambda one: self._points[one][-1][0])
                    del self._points[oldest]
                points = self._points[key] = deque(maxlen=POINTS)
            if not points or now_s - points[-1][0] >= POINT_S:
                points.append((now_s, values))


def charted(key: str, fields: Mapping[str, Any]) -> list[float | None] | None:
    """What a chart shows of a row; None: nothing.

    Lag and freeze of a component, in ms; the value of an item; of a link with slots the last round, in ms, and who shares it.
    """
    if key.startswith("component:"):
        freeze_us = fields.get("freeze_us")
        return [fields.get("lag_ms"), None if freeze_us is None else freeze_us / 1000]
    if key.startswith("medium:"):
        return [fields["round_ms"], fields["count"]] if fields["own"] else None
    value = fields.get("value") if key.startswith("item:") else None
    return [float(value)] if isinstance(value, int | float) and not isinstance(value, bool) else None


def _kept_where_equal(before: Table, after: Table) -> Table:
    """The same as ``after``; rows that are equal are the older objects, which `page.picture.changes` passes over."""
    return {key: before[key] if before.get(key) == fields else fields for key, fields in after.items()}
