"""One client of the page, over one WebSocket: it gets the picture once, then changes; it says what it looks at.

A client that reads slowly is told less often, and never gets a backlog: it is sent the difference between the newest picture and
the last one that it took.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec

from checkpoint.errors import UNDECODABLE
from failover.client.control import Output
from failover.errors import FailoverError
from page.agent_link import AgentLink
from page.errors import TurnedAwayError
from page.feeds import Feed, Feeds, charted
from page.limits import LOOK_S, MESSAGES_A_S, MESSAGES_AT_ONCE, OUTPUT_HELD, OUTPUT_TAIL, PERIOD_S, STORY_LINES
from page.orders import Orders
from page.picture import Table, changes
from page.rate import Rate
from page.sessions import Session

COMPONENT: Final = "component:"

STORY_AGAIN_S: Final = 10.0
"""How old a timeline gets while its component stands still."""

OLD_AGAIN_S: Final = 1.0
"""Between two words to a client that a picture is old."""

OUTPUT_AGAIN_S: Final = 2.0
"""Between two tries to follow an output that cannot be had."""

_DECIDED: Final = ("epoch", "state", "primary", "standby", "word")
"""Fields of a component that a decision changes."""


class Look(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All that a client may say: the row that it looks at, "" for none."""

    look: Annotated[str, msgspec.Meta(max_length=400)]


class Viewer:
    """The server's end of one client."""

    def __init__(self, session: Session, feed: Feed, people: People, wake: asyncio.Event, socket: Path | None) -> None:
        """
        Args:
            wake: set when there may be something new.
        """
        self.session = session
        self.look = ""
        self.wake = wake
        self.feed = feed
        self._people = people
        self._socket = socket
        self._sent: Table = {}
        self._output: dict[int, bytearray] = {}
        self._left_out = 0
        self._output_says = self._output_said = ""
        self._extra: dict[str, dict[str, Any]] = {}
        self._wanted: str | None = None
        self._looking: asyncio.Task[None] | None = None
        self._following: list[asyncio.Task[None]] = []
        self._rate = Rate(MESSAGES_A_S, MESSAGES_AT_ONCE)

    async def speak(self, send: Callable[[str], Awaitable[None]]) -> None:
        """Send what is new, at most five times a second, until it is cancelled or the client is gone."""
        hello = {"user": self.session.user, "period_ms": round(PERIOD_S * 1000)}
        await send(_said({"hello": hello}))
        while True:
            self.wake.clear()
            for message in self._news():
                await send(_said(message))
            await asyncio.sleep(PERIOD_S)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(OLD_AGAIN_S):
                    await self.wake.wait()

    async def listen(self, receive: Callable[[], Awaitable[str]]) -> None:
        """Take what the client says.

        Raises:
            TurnedAwayError: it says what no client of ours says, or too much; the connection is to be closed.
        """
        while True:
            text = await receive()
            if self._rate.wait_s():
                raise TurnedAwayError(429, "too many messages in a short time")
            try:
                wanted = _looks.decode(text)
            except UNDECODABLE as error:
                raise TurnedAwayError(400, f"a message that no page of ours sends: {error}") from error
            self._wanted = wanted.look
            if self._looking is None or self._looking.done():
                self._looking = asyncio.create_task(self._look_around())

    async def close(self) -> None:
        """Follow nothing any more."""
        if self._looking is not None:
            self._looking.cancel()
            await asyncio.gather(self._looking, return_exceptions=True)
        await self._unfollow()

    async def _unfollow(self) -> None:
        for task in self._following:
            task.cancel()
        await asyncio.gather(*self._following, return_exceptions=True)
        self._following = []

    # --- What is new ---

    def _news(self) -> list[dict[str, Any]]:
        table = {**self.feed.table, **self._people.table(self)}
        if old_s := self.feed.old_s():
            table["team"] = {**table["team"], "old_s": old_s}
        news = changes(self._sent, table)
        self._sent = table
        messages = [*([news] if news else []), *self._extra.values()]
        self._extra = {}
        if self._output or self._left_out or self._output_says != self._output_said:
            texts = {stream: content.decode(errors="replace") for stream, content in self._output.items()}
            told = {"name": self.look.removeprefix(COMPONENT), "left_out": self._left_out, "says": self._output_says}
            messages.append({"output": told | {"text": texts}})
            self._output, self._left_out, self._output_said = {}, 0, self._output_says
        return messages

    def _tell(self, kind: str, message: dict[str, Any]) -> None:
        """The newest of its kind, for a client that reads slowly."""
        self._extra[kind] = {kind: message}
        self.wake.set()

    # --- What is looked at ---

    async def _look_around(self) -> None:
        """Look at what was wanted last, and not at all that was wanted before it."""
        while self._wanted is not None:
            wanted, self._wanted = self._wanted, None
            await self._look_at(wanted)
            await asyncio.sleep(LOOK_S)

    async def _look_at(self, key: str) -> None:
        await self._unfollow()
        self._output, self._left_out, self._output_says, self._output_said, self._extra = {}, 0, "", "", {}
        self.look = key if key in self.feed.table else ""
        self._people.changed()
        fields = self.feed.table.get(self.look)
        if fields is None:
            return
        if charted(self.look, fields) is not None:
            self._tell("past", {"key": self.look, "points": self._people.feeds.past(self.look)})
        if self.look.startswith(COMPONENT):
            name = self.look.removeprefix(COMPONENT)
            self._following = [asyncio.create_task(self._follow_story(name)), asyncio.create_task(self._follow_output(name))]

    async def _follow_story(self, name: str) -> None:
        """The decisions about a component, again when it has changed."""
        last: object = None
        while True:
            fields = self.feed.table.get(COMPONENT + name, {})
            seen = [fields.get(part) for part in _DECIDED]
            try:
                async with await AgentLink.open(self._socket) as link:
                    told = await link.ask("why", self.session.uid, name=name)
                story = [_brief(line) for line in told["story"][-STORY_LINES:]]
                silent = [one["robot"] for one in told["robots"] if not one["answered"]]
                message = {"name": name, "lines": story, "silent": silent, "says": ""}
            except FailoverError as error:
                message = {"name": name, "lines": [], "silent": [], "says": str(error)}
            if message != last:
                last = message
                self._tell("story", message)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(STORY_AGAIN_S):
                    while seen == [self.feed.table.get(COMPONENT + name, {}).get(part) for part in _DECIDED]:
                        await asyncio.sleep(PERIOD_S)

    async def _follow_output(self, name: str) -> None:
        """The end of what its program has written, and all that follows; also after another start."""
        offsets = [-OUTPUT_TAIL, -OUTPUT_TAIL]
        while True:
            began = self._standing(name)
            try:
                async with await AgentLink.open(self._socket) as link:
                    replies = link.stream("logs", self.session.uid, name=name, follow=True, offsets=offsets)
                    async with contextlib.aclosing(replies):
                        async for reply in replies:
                            if isinstance(reply, Output):
                                offsets[reply.stream - 1] = reply.offset + len(reply.content)
                                self._output_says = ""
                                self._hold(reply)
                self._output_says = "it has ended"
                self.wake.set()
                ended = self._standing(name)
                while self._standing(name) in (began, ended):
                    await asyncio.sleep(PERIOD_S)
                offsets = [-OUTPUT_TAIL, -OUTPUT_TAIL]
            except FailoverError as error:
                self._output_says = str(error)
                self.wake.set()
                await asyncio.sleep(OUTPUT_AGAIN_S)

    def _standing(self, name: str) -> list[Any]:
        """What another start of a component changes."""
        fields = self.feed.table.get(COMPONENT + name, {})
        return [fields.get("state"), fields.get("epoch"), fields.get("pid")]

    def _hold(self, reply: Output) -> None:
        held = self._output.setdefault(reply.stream, bytearray())
        held += reply.content
        over = len(held) - OUTPUT_HELD
        if over > 0:
            del held[:over]
            self._left_out += over
        self.wake.set()


_looks: Final = msgspec.json.Decoder(Look)


class People:
    """All clients that are connected, and the log of orders: what they see of each other."""

    def __init__(self, feeds: Feeds) -> None:
        self.feeds = feeds
        self.orders: Orders | None = None
        self.viewers: set[Viewer] = set()

    def windows_of(self, session: Session) -> int:
        """How many windows the user of a session has open."""
        return sum((one.session.user, one.session.uid) == (session.user, session.uid) for one in self.viewers)

    def changed(self) -> None:
        """Someone came, went or looks elsewhere, or an order stands otherwise."""
        for viewer in self.viewers:
            viewer.wake.set()

    def table(self, viewer: Viewer) -> Table:
        """People and orders, as far as they concern what this viewer may see."""
        visible = viewer.feed.table
        found: Table = {}
        for number, other in enumerate(sorted(self.viewers, key=lambda one: (one.session.user, id(one)))):
            looks = other.look if other.look in visible else ""
            found[f"person:{number}"] = {"user": other.session.user, "looks": looks, "me": other is viewer}
        for number, (own, told) in self.orders.log.items() if self.orders is not None else ():
            if told["user"] == viewer.session.user:
                found[f"order:{number}"] = own
            elif f"component:{told['name']}" in visible or f"driver:{told['name']}" in visible:
                found[f"order:{number}"] = told
        return found


def _brief(line: dict[str, Any]) -> dict[str, Any]:
    """A decision as the timeline shows it."""
    fields = ("at", "doubt_ms", "robot", "component", "did", "repeats", "epoch_before", "epoch", "state", "checkpoint_age_ms")
    seen = [{name: one.get(name) for name in ("robot", "state", "silent_ms", "hears_us")} for one in line.get("seen") or ()]
    return {name: line.get(name) for name in fields} | {"seen": seen}


def _said(message: dict[str, Any]) -> str:
    return msgspec.json.encode(message, enc_hook=str).decode()
