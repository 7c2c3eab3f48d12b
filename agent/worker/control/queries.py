"""Queries that every member answers: the present state, and the reasons of past decisions.

`agent.worker.control.verbs` adds the orders. A witness answers by this module alone: nothing here needs more than the core's view
of the team.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import os
from collections.abc import Callable, Collection
from typing import Any, Final, Protocol

from agent.config import Settings
from agent.errors import RefusedError
from agent.main_loop.messages import Told
from agent.system.permissions import may, refusal_without_rules, without_output
from agent.worker.control.arguments import (
    DECISIONS_ASKED_MAX,
    MayArguments,
    NameArguments,
    RightsArguments,
    StatusArguments,
    WhyArguments,
    arguments_of,
)
from agent.worker.control.reservations import Reservations
from agent.worker.control.rights_gate import RIGHT_OF, RightsGate
from agent.worker.control.server import Conversation, Verb
from agent.worker.control.status_view import version
from agent.worker.control.why_view import Telling
from agent.worker.network.remote_orders import Errands, Order
from failover.client.health import is_healthy
from failover.config import accounts
from failover.core import acts, events
from failover.core.rights.rules import Subject
from failover.core.types import State

SIGHT_PATIENCE_S: Final = 2.0
"""How long a status waits for the other robots' own: where no answer came from counts as not known, and busy robots are late."""

LIVING: Final = ("live", "suspect")
"""States of peers that are asked: on a busy machine three beats may be late at any time."""

WORK: Final = (
    *("run", "protect", "logs", "handover", "failback", "prefer", "promote", "release", "start", "stop", "drain"),
    *("reserve", "unreserve"),
)
"""What takes a program, its output, or a word that others obey."""

DECISIONS_AT_ONCE: Final = 50
"""Answers of ``may`` before other clients have their turn."""

QUESTIONS: Final = ("standing", "picture", "story")
"""What any member may ask of another one. The rest are orders, and a witness's are refused: it may be any user's process."""


NOT_HERE: Final[dict[str, Any]] = {
    "state": "absent",
    "role": "none",
    "epoch": 0,
    "lacks": None,
    "cold": "",
    "unstored": "",
    "notes": [],
    "reasons": [],
}
"""Of a component that this robot has not heard of, in place of what another one says of itself."""


class Lines(Protocol):
    """What of `agent.worker.hub.Switchboard` is needed here."""

    settings: Settings
    errands: Errands

    async def ask(self, what: Any) -> Told: ...
    async def command(self, make: Callable[[int], events.Command | events.Drain]) -> acts.Answer: ...
    def hindrance(self, peer: str) -> str: ...
    def picture(self, told: Told) -> dict[str, Any]: ...


class Questions:
    """The verbs of the control socket that every member has."""

    def __init__(self, lines: Lines, gate: RightsGate | None = None) -> None:
        """
        Args:
            gate: the rules of rights; None: there are none.
        """
        self._lines = lines
        self._gate = gate
        self.telling = Telling(lines)
        self.reservations: Reservations | None = None

    def table(self) -> dict[str, Verb]:
        """By name, as the client says them."""
        return {
            "ping": self.ping,
            "status": self.status,
            "why": self.why,
            "rights": self.rights,
            "may": self.may,
            **dict.fromkeys(WORK, self._no_work),
        }

    def gated(self) -> dict[str, Verb]:
        """The same, each behind the rules of rights."""
        return {name: functools.partial(self._gated, name, verb) for name, verb in self.table().items()}

    async def _gated(self, name: str, verb: Verb, say: Conversation, arguments: dict[str, Any]) -> dict[str, Any]:
        """Do what is asked, if the rules let this user; without rules each verb has its own."""
        if (gate := self._rules()) is not None:
            path, owner = await self._about(name, arguments)
            await gate.check(say.caller.uid, RIGHT_OF[name], path, owner)
        return await verb(say, arguments)

    def _rules(self) -> RightsGate | None:
        return self._gate if self._gate is not None and self._gate.has_rules else None

    async def _about(self, verb: str, arguments: dict[str, Any]) -> tuple[str, int | None]:
        """The path that a verb is about, and the owner of the component there; this robot where no component is named."""
        own = f"/{self._lines.settings.team.team}/{self._lines.settings.config.robot}"
        name = str(arguments.get("name", ""))
        if not name and verb == "run":
            argv = arguments.get("argv")
            name = named_after(argv[0] if isinstance(argv, list) and argv else "")
        if not name:
            return own, None
        if verb not in ("run", "protect"):
            with contextlib.suppress(RefusedError):  # the verb refuses it, once the rules have: its sentence tells names
                name = await self._known(name)
        name = name if name.startswith("/") else f"{own}/{name}"
        return name, (await self._view(name)).get("owner")

    def errands(self) -> dict[str, Order]:
        """What another robot may ask of this one: how things stand here."""
        return {"standing": self.standing, "picture": self.picture, "story": self.telling.page}

    async def _no_work(self, _say: Conversation, _arguments: dict[str, Any]) -> dict[str, Any]:
        me = self._lines.settings.config.robot
        raise RefusedError(f"{me} is a witness: it votes, and neither runs nor keeps nor orders anything; ask at a robot")

    async def ping(self, _say: Conversation, _arguments: dict[str, Any]) -> dict[str, Any]:
        """Who are you?"""
        await self._lines.ask("status")
        config = self._lines.settings.config
        team = self._lines.settings.team.team
        return {"robot": config.robot, "team": team, "pid": os.getppid(), "version": version(), "insecure": config.insecure}

    async def status(self, say: Conversation, arguments: dict[str, Any]) -> dict[str, Any]:
        """How does the team stand?"""
        wanted = arguments_of(StatusArguments, "status", arguments)
        while wanted.watch:
            await say.update(await self._sight(wanted.team, say.caller.uid))
            await asyncio.sleep(max(wanted.every_ms, 10) / 1_000)
        return await self._sight(wanted.team, say.caller.uid)

    async def _sight(self, team: bool, uid: int) -> dict[str, Any]:
        """This robot's picture, for a user; with ``team`` each component also as the other living robots see it."""
        mine = await self.joined(None if team else ())
        if team:
            mine["healthy"] = is_healthy(mine)
        mine["components"] = await self._shown(uid, mine["components"])
        if mine.get("reservations") and (gate := self._rules()) is not None:
            asker = await gate.subject(uid, "see")
            mine["reservations"] = [one for one in mine["reservations"] if gate.decision(asker, "see", one["path"], None)]
        mine["rights"] = self._gate.standing() if self._gate is not None else ""
        return mine

    async def joined(self, robots: Collection[str] | None) -> dict[str, Any]:
        """This robot's picture, with what others say: of these robots those that live and answer; None: of all."""
        mine = await self._picture()
        for component in mine["components"]:
            component["elsewhere"] = {}
        if robots is not None and not robots:
            return mine
        asked = [robot for robot in await self._reachable() if robots is None or robot in robots]
        answers = await asyncio.gather(*(self._asked(peer, "picture", {}) for peer in asked))
        _join(mine, {robot: picture for robot, picture in zip(asked, answers, strict=True) if picture})
        return mine

    async def _shown(self, uid: int, components: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """The components that a user may see, as the user may see them."""
        if (gate := self._rules()) is None:
            return [_shown_to(uid, one) for one in components]
        asker = await gate.subject(uid, "see")
        return [_by_rules(gate, asker, one) for one in components if gate.decision(asker, "see", one["name"], one.get("owner"))]

    async def _reachable(self) -> list[str]:
        """The robots that live and can be asked."""
        peers = self._lines.picture(await self._lines.ask("status"))["peers"]
        return [peer["name"] for peer in peers if peer["state"] in LIVING and not self._lines.hindrance(peer["name"])]

    async def _asked(self, peer: str, question: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """A peer's answer; empty when it does not come soon."""
        try:
            return await self._lines.errands.send(peer, question, arguments, patience_s=SIGHT_PATIENCE_S)
        except RefusedError:
            return {}

    async def why(self, say: Conversation, arguments: dict[str, Any]) -> dict[str, Any]:
        """What was decided, when and by whom: the event logs of all robots that answer, in one.

        What programs said is left out but for root: a line does not tell whose component had the name then.
        """
        wanted = arguments_of(WhyArguments, "why", arguments)
        name = await self._known(wanted.name) if wanted.name else ""
        told = await self.telling.whole(name, wanted.robot, wanted.age_ms_max)
        if (gate := self._rules()) is not None:
            asker = await gate.subject(say.caller.uid, "see")
            names = {line["component"] for line in told["story"]}
            hidden = {one for one in names if one and not gate.decision(asker, "see", one, (await self._view(one)).get("owner"))}
            told = {**told, "story": [line for line in told["story"] if line["component"] not in hidden]}
        return told if may(say.caller.uid, None) else {**told, "story": without_output(told["story"])}

    async def rights(self, say: Conversation, arguments: dict[str, Any]) -> dict[str, Any]:
        """May a user do something, and by which rule? Of another user root may ask, and users with the right ``grant``."""
        wanted = arguments_of(RightsArguments, "rights", arguments)
        if (gate := self._rules()) is None:
            raise RefusedError("this robot has no rights.toml; failover rights why decides that without an agent")
        uid = say.caller.uid
        if not may(uid, None) and await asyncio.to_thread(accounts.name_of, uid) != wanted.user:
            await gate.check(uid, "grant", wanted.path)
        owner = (await self._view("/" + wanted.path.removeprefix("/"))).get("owner")
        answer, subject = await gate.explained(wanted.user, wanted.right, wanted.path, owner)
        told = {"allow": answer.allow, "because": answer.because, "groups": sorted(subject.groups)}
        return told | {"place": answer.rule.place if answer.rule is not None else ""}

    async def may(self, say: Conversation, arguments: dict[str, Any]) -> dict[str, Any]:
        """Which of these rights does the asking user have at these paths?"""
        wanted, uid = arguments_of(MayArguments, "may", arguments), say.caller.uid
        if len(wanted.rights) * len(wanted.paths) > DECISIONS_ASKED_MAX:
            raise RefusedError(
                f"may: {len(wanted.rights)} rights at {len(wanted.paths)} paths; ask {DECISIONS_ASKED_MAX} at a time"
            )
        told = await self._lines.ask("status")
        owners = {one.name: one.owner for one in told.status.components} if told.status else {}
        gate = self._rules()
        answers: dict[str, dict[str, str]] = {}
        for right in wanted.rights:
            asker = await gate.subject(uid, right) if gate is not None else None
            found = answers[right] = {}
            for number, path in enumerate(wanted.paths):
                if number % DECISIONS_AT_ONCE == 0:
                    await asyncio.sleep(0)
                if gate is not None and asker is not None:
                    answer = gate.decision(asker, right, path, owners.get(path))
                    found[path] = "" if answer else answer.because
                else:
                    found[path] = refusal_without_rules(uid, right, path, owners)
                if right == "operate" and not found[path] and self.reservations is not None:
                    found[path] = self.reservations.refusal(uid, path)
        return {"robot": self._lines.settings.config.robot, "team": self._lines.settings.team.team, "answers": answers}

    async def standing(self, arguments: dict[str, Any], _by: int) -> dict[str, Any]:
        """How one component stands on this robot; empty where it is unknown."""
        return await self._view(arguments_of(NameArguments, "standing", arguments).name)

    async def _picture(self) -> dict[str, Any]:
        """What this robot itself sees."""
        found = self._lines.picture(await self._lines.ask("status"))
        if self.reservations is not None:
            self.reservations.show(found)
        return found

    async def picture(self, _arguments: dict[str, Any], _by: int) -> dict[str, Any]:
        """All of this robot's own sight, for another robot's status."""
        return await self._picture()

    # --- what verbs share ---

    async def _view(self, name: str) -> dict[str, Any]:
        """The component's part of the picture; empty when it is unknown."""
        picture = await self._picture()
        return next((one for one in picture["components"] if one["name"] == name), {})

    async def _names(self) -> dict[str, State]:
        """Every component that this robot has heard of, and how it stands here."""
        told = await self._lines.ask("status")
        return {one.name: one.state for one in told.status.components} if told.status else {}

    async def _known(self, wanted: str) -> str:
        """The component that a person means: its whole name, or an end of it that fits one alone.

        Raises:
            RefusedError: none, or more than one.
        """
        names = await self._names()
        if wanted in names:
            return wanted
        fitting = [name for name in names if name.endswith("/" + wanted.lstrip("/"))]
        if len(fitting) == 1:
            return fitting[0]
        if fitting:
            raise RefusedError(f"{wanted!r} could be {', '.join(sorted(fitting))}; give the whole name", "UnknownComponentError")
        known = ", ".join(sorted(name for name, state in names.items() if state is not State.RELEASED)) or "nothing"
        raise RefusedError(f"no component is called {wanted!r}; this team protects {known}", "UnknownComponentError")


def named_after(command: object) -> str:
    """The last part of a component's name that is made from its command."""
    return os.path.basename(str(command)) or "program"


def _shown_to(uid: int, one: dict[str, Any]) -> dict[str, Any]:
    """A component as a user may see it; a name may be another user's at another robot, while that has not heard the news."""
    elsewhere = {robot: _shown_to(uid, seen) for robot, seen in one.get("elsewhere", {}).items()}
    seen = one if may(uid, one.get("owner")) else without_output(one)
    return {**seen, "elsewhere": elsewhere} if "elsewhere" in one else seen


def _by_rules(gate: RightsGate, asker: Subject, one: dict[str, Any]) -> dict[str, Any]:
    """The same by the rules of rights."""
    elsewhere = {robot: _by_rules(gate, asker, seen) for robot, seen in one.get("elsewhere", {}).items()}
    seen = one if gate.decision(asker, "read", one["name"], one.get("owner")) else without_output(one)
    return {**seen, "elsewhere": elsewhere} if "elsewhere" in one else seen


def _join(mine: dict[str, Any], theirs: dict[str, dict[str, Any]]) -> None:
    """Add to a robot's picture what the others say: of its components, of those that it does not know, and of their peers."""
    known = {one["name"]: one for one in mine["components"]}
    for robot, picture in theirs.items():
        for one in picture.get("components", ()):
            if one["name"] not in known:
                known[one["name"]] = {**one, **NOT_HERE, "elsewhere": {}}
                mine["components"].append(known[one["name"]])
            known[one["name"]]["elsewhere"][robot] = one
    mine["components"].sort(key=lambda one: str(one["name"]))
    mine["doubted_elsewhere"] = {
        robot: [peer["name"] for peer in picture.get("peers", ()) if peer.get("doubted")] for robot, picture in theirs.items()
    }
    mine["peers_elsewhere"] = {
        robot: {peer["name"]: peer["state"] for peer in picture.get("peers", ())} for robot, picture in theirs.items()
    }
