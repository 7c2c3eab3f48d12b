"""Members join, leave and replace their keys while the agents work: asked for here, granted to another robot, taken from it.

The rule is `failover.core.team_changes`: one member at a time, each change with the grants of all members. Here are the acts:
asking the others, the team file, and, by `Lines.take_team`, the links and the main loop. No agent starts anew.
"""

from __future__ import annotations

import asyncio
import functools
import logging
import os
import signal
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from hashlib import blake2b
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

import msgspec

from agent.config import Settings, check_team, is_by_pair
from agent.errors import AgentError, RefusedError
from agent.main_loop.messages import Told
from agent.system import clock
from agent.system.permissions import may
from agent.worker.control.arguments import TakenTeam, TeamArguments, arguments_of
from agent.worker.control.server import Conversation
from agent.worker.network.remote_orders import Errands, OrderOfPeer
from failover.config import team as team_file
from failover.config.team import Robot, Team, sites_of
from failover.core import acts, events
from failover.core.team_changes import TWO_KEYS, USE_NS, Elections, Grants, acts_unheard, missing, step, unaware
from failover.core.types import ENDED, HOLDING, PeerView
from failover.errors import FailoverError

GRANT_PATIENCE_S: Final = 15.0
"""A member that does not answer in this time counts as one that cannot be reached."""

BEHIND_S: Final = 1.0
"""Between two looks for members that have not taken the newest change yet."""

LEAVE_S: Final = 0.5
"""So long after its answer a robot that was taken out ends its agent: the answer is on its way by then."""

LEAVE_PATIENCE_S: Final = 3.0
"""For the answer of a member that is taken out: until then this robot sends heartbeats to it still."""

ROTATION_PATIENCE_S: Final = 90.0
"""For another robot that replaces its key: two changes, and its connections made anew."""

LOOK_S: Final = 0.1
"""Between two looks for a connection, or for a rotation's end."""

CONNECT_PATIENCE_S: Final = 10.0
"""For connections with another key; a grant holds for longer than that."""

AWARE_PATIENCE_NS: Final = 3_000_000_000
"""For members to hear of an election that a change must wait for: a heartbeat tells it."""

UNHEARD_NS: Final = 10_000_000_000
"""A member that was not heard since this agent's start counts as one that lives for so long: it may be starting, too."""

ALIVE: Final = ("alive", "suspect")
RESTARTING: Final = "restarting"
"""Its agent is away, as it announced, and what it runs acts on."""

TEAM_IS: Final = "team_is"
"""The question which team a robot has: any member may ask it, and a former one as well."""

ROTATE: Final = "team_rotate"
ROTATED: Final = "team_rotated"
"""The order to replace one's key, and the question how far that is."""

TEAM_TOLD: Final = ("team_taken", TEAM_IS)
"""What a witness may say of the team, too: it is not believed alone."""

log = logging.getLogger("failover.lanes")


class Answer(NamedTuple):
    """Of a member that was asked for its grant.

    Attributes:
        sees: it hears the robot that is to leave.
        members: digest of the team that it has granted.
        rule: as its agent.toml gives it; ``elections``: that it knows of; None: its release does not tell that.
    """

    granted: bool = False
    refusal: str = ""
    sees: bool = False
    members: int = 0
    rule: str = ""
    elections: Elections | None = None


class Lines(Protocol):
    """What of `agent.worker.hub.Switchboard` is needed here."""

    settings: Settings
    errands: Errands

    async def ask(self, what: Any) -> Told: ...
    async def command(self, make: Callable[[int], events.Command]) -> acts.Answer: ...
    def hindrance(self, peer: str) -> str: ...
    async def take_team(self, team: Team) -> None: ...
    async def take_secret(self, secret: str) -> None: ...


class TeamChanges:
    """The changes of the team, as one member sees them. Lives in the worker's loop.

    Attributes:
        conflicts: peer → sentence: it has another change with the same number.
    """

    def __init__(self, lines: Lines) -> None:
        self._lines = lines
        self._grants = Grants()
        self._busy = asyncio.Lock()
        self._taking = asyncio.Lock()
        self._work: set[asyncio.Task[dict[str, Any]]] = set()
        self._behind: dict[str, int] = {}
        self._rotation: asyncio.Task[dict[str, Any]] | None = None
        self.conflicts: dict[str, str] = {}

    def orders(self) -> dict[str, OrderOfPeer]:
        """What another robot may order."""
        return {
            "team_grant": self._granted,
            "team_taken": self._taken,
            "team_let_go": self._let_go,
            TEAM_IS: self._is,
            ROTATE: self._ordered_to_rotate,
            ROTATED: self._how_far,
        }

    def notes(self) -> list[str]:
        """What is wrong with the team, for the status."""
        settings = self._lines.settings
        is_half = bool(settings.me.next_key) and not self._busy.locked()
        half = [TWO_KEYS.format(robot=settings.config.robot)] if is_half else []
        return [*self.conflicts.values(), *half]

    def heard(self, peer: str, change: int, members: int) -> None:
        """A peer, or a former member, says on a new connection how often its team was changed."""
        ours = self._lines.settings.team
        self._behind.pop(peer, None)
        self.conflicts.pop(peer, None)
        if change < ours.change:
            self._behind[peer] = change
        elif change == ours.change and change and members != digest(ours.robots):
            self.conflicts[peer] = (
                f"{peer} has another change {change} of the team: copy the team.toml that most robots have to the others, and "
                "restart their agents"
            )

    async def bring_up_to_date(self) -> None:
        """Members that were away get the newest change as soon as they are back, and former ones hear that they are out."""
        while True:
            await asyncio.sleep(BEHIND_S)
            await self._tell_who_is_behind()

    async def _tell_who_is_behind(self) -> None:
        settings = self._lines.settings
        known = {*settings.others, *settings.former}
        self._behind = {peer: change for peer, change in self._behind.items() if peer in known}
        there = [peer for peer in self._behind if not self._lines.hindrance(peer)]
        await asyncio.gather(*(self._told(peer, settings.team) for peer in there))

    # --- asked for here ---

    async def verb(self, say: Conversation, arguments: dict[str, Any]) -> dict[str, Any]:
        """Change the team, for root: see `failover.client.control`. It goes on if the client hangs up."""
        wanted = arguments_of(TeamArguments, "team", arguments)
        if not may(say.caller.uid, None):
            raise RefusedError("only root may change the team", "PermissionError")
        if wanted.act == "rotate" and wanted.robot not in ("", self._lines.settings.config.robot):
            return await self._have_rotated(wanted.robot)
        work = await self._begun(self._rotated() if wanted.act == "rotate" else self._change(wanted))
        try:
            return await asyncio.shield(work)
        except FailoverError as error:
            raise RefusedError(str(error), type(error).__name__) from error

    async def _begun(self, change: Coroutine[Any, Any, dict[str, Any]]) -> asyncio.Task[dict[str, Any]]:
        """Begin a change; it goes on whoever waits for it.

        Raises:
            RefusedError: another one is under way.
        """
        if self._busy.locked():
            change.close()
            raise RefusedError("another change of the team is under way at this robot; wait for it")
        await self._busy.acquire()
        work = asyncio.create_task(self._alone(change))
        self._work.add(work)
        work.add_done_callback(self._work.discard)
        work.add_done_callback(_note_refusal)
        return work

    async def _alone(self, change: Coroutine[Any, Any, dict[str, Any]]) -> dict[str, Any]:
        try:
            return await change
        finally:
            self._grants.done(self._lines.settings.config.robot)
            self._busy.release()

    async def _change(self, wanted: TeamArguments) -> dict[str, Any]:
        settings, before = self._lines.settings, self._lines.settings.team
        removed = wanted.robot if wanted.act == "remove" else ""
        after = _wanted(before, wanted, settings.config.robot)
        check_team(settings, after)
        self.check_that_it_can_be_written()
        if removed:
            refuse(await self._objection(removed, after))
        return await self.agreed(before, after, removed)

    async def agreed(
        self, before: Team, after: Team, removed: str = "", prepare: Callable[[], Awaitable[None]] | None = None
    ) -> dict[str, Any]:
        """Have all grant a change, and make it.

        Args:
            prepare: what this robot does once all have granted it, before any has it.

        Raises:
            RefusedError: nothing has changed.
        """
        settings = self._lines.settings
        peers = list(settings.others)
        is_written = False
        try:
            granted_ns = await self._be_granted(before, after, removed)
            if prepare is not None:
                await prepare()
            if clock.now_ns() - granted_ns > USE_NS:
                raise RefusedError("cannot change the team: its members took too long to agree; try again")
            async with self._taking:
                if self._lines.settings.team != before:
                    raise RefusedError("the team has changed meanwhile; give the command again")
                await asyncio.to_thread(self._write, after)
                is_written = True
                waiting = await self._go_over(after, peers, removed)
        finally:
            if not is_written:
                await asyncio.gather(*(self._free(peer) for peer in peers))
        self._behind |= dict.fromkeys(waiting, before.change)
        return {"team": after.team, "robots": sorted(after.robots), "change": after.change, "waiting": waiting}

    async def _go_over(self, after: Team, peers: list[str], removed: str) -> list[str]:
        """The change is in our file: tell all, and act on it. Returns the members that could not be told.

        One that is taken out hears of it while our heartbeats still reach it: it has ended before it takes us for dead.
        """
        gone = [removed] if removed and not await self._told(removed, after, LEAVE_PATIENCE_S) else []
        others = [peer for peer in peers if peer != removed]
        *done, _ = await asyncio.gather(*(self._told(peer, after) for peer in others), self._lines.take_team(after))
        self._behind |= dict.fromkeys(gone, after.change - 1)
        return [peer for peer, took in zip(others, done, strict=True) if not took]

    async def _be_granted(self, before: Team, after: Team, removed: str) -> int:
        """When all have been asked; they grant it.

        Raises:
            RefusedError: a member refuses, or cannot be asked; nothing has changed.
        """
        asked_ns = clock.now_ns()
        await self._tell_who_is_behind()
        while waits := _waits(before, after, await self._grants_of_all(before, after, removed)):
            if clock.now_ns() - asked_ns > AWARE_PATIENCE_NS:
                raise RefusedError(
                    f"cannot change the team: {waits}; nothing has changed. Try again; if it stays so, restart the robot at "
                    "which failover status shows that component held still"
                )
            await asyncio.sleep(LOOK_S)
        return asked_ns

    async def _grants_of_all(self, before: Team, after: Team, removed: str) -> dict[str, Answer]:
        """Ask all, this robot among them: the answers of those that have granted the change. Raises RefusedError: as above."""
        me = self._lines.settings.config.robot
        if refusal := self._grants.ask(before.change, before.change, me, clock.now_ns(), digest(after.robots)):
            raise RefusedError(f"cannot change the team at {me}: {refusal}")
        lives = bool(removed) and await self._may_live(removed)
        others = [peer for peer in self._lines.settings.others if peer != removed or lives]
        answers = dict(zip(others, await asyncio.gather(*(self._asked(peer, before, after) for peer in others)), strict=True))
        if refusals := [f"{peer}: {answer.refusal}" for peer, answer in answers.items() if answer.refusal]:
            raise RefusedError(f"cannot change the team: {'; '.join(refusals)}")
        granted = {me, *(peer for peer, answer in answers.items() if answer.granted)}
        blind = [peer for peer, answer in answers.items() if answer.granted and answer.members != digest(after.robots)]
        if blind and any(sites_of(after).values()):
            raise RefusedError(
                f"cannot change the team: it has sites, and the release of {', '.join(blind)} knows none: a majority would be "
                "another one there; install the same release there first"
            )
        if sees := [peer for peer, answer in answers.items() if answer.sees and removed not in granted]:
            raise RefusedError(f"cannot change the team: {removed} lives, as {sees[0]} sees; stop its agent first")
        if short := missing(before.robots, granted, removed, lives=lives):
            raise RefusedError(
                f"cannot change the team: each of its {len(before.robots)} members must agree, and {', '.join(short)} cannot be "
                "reached; nothing has changed. Bring it back, or take out one that is lost: failover team remove ROBOT"
            )
        own = Answer(True, rule=self._lines.settings.config.rule, elections=(await self._lines.ask("elections")).elections)
        return {me: own} | {peer: answer for peer, answer in answers.items() if answer.granted}

    async def _asked(self, peer: str, before: Team, after: Team) -> Answer:
        """What a member says; neither granted nor refused where it cannot be reached."""
        question = told_of(after) | {"proposer": self._lines.settings.config.robot, "have": before.change}
        try:
            answer = await self._lines.errands.send(peer, "team_grant", question, patience_s=GRANT_PATIENCE_S)
        except RefusedError as error:
            log.info("%s does not answer about the team: %s", peer, error)
            return Answer()
        refusal = str(answer.get("refusal", ""))
        members, rule = answer.get("members"), str(answer.get("rule", ""))
        try:
            known = msgspec.convert(answer["elections"], Elections)
        except (KeyError, msgspec.ValidationError):
            known = None  # its release tells none
        return Answer(not refusal, refusal, bool(answer.get("sees")), members if isinstance(members, int) else 0, rule, known)

    async def _free(self, peer: str) -> None:
        if self._lines.hindrance(peer):
            return
        try:
            await self._lines.errands.send(peer, "team_let_go", {}, patience_s=GRANT_PATIENCE_S)
        except RefusedError as error:
            log.info("the grant of %s ends by itself: %s", peer, error)

    async def _told(self, peer: str, team: Team, patience_s: float = GRANT_PATIENCE_S) -> bool:
        """Whether a member has taken the change."""
        try:
            await self._lines.errands.send(peer, "team_taken", told_of(team), patience_s=patience_s)
        except RefusedError as error:
            log.warning("%s has not taken change %d of the team: %s", peer, team.change, error)
            return False
        self._behind.pop(peer, None)
        return True

    # --- this robot's key ---

    async def _rotated(self) -> dict[str, Any]:
        from agent.worker.key_rotation import KeyRotation  # here: an agent that replaces no key does not load it

        return await KeyRotation(self, self._lines).run()

    async def until_reached(self, peer: str) -> None:
        """Wait for a connection that was made anew, for a while."""
        until_ns = clock.now_ns() + int(CONNECT_PATIENCE_S * 1e9)
        while self._lines.hindrance(peer) and clock.now_ns() < until_ns:
            await asyncio.sleep(LOOK_S)

    async def _have_rotated(self, robot: str) -> dict[str, Any]:
        """Have another robot replace its key. The connections over which it answers are made anew meanwhile."""
        await self._lines.errands.send(robot, ROTATE, {}, patience_s=GRANT_PATIENCE_S)
        until_ns, trouble = clock.now_ns() + int(ROTATION_PATIENCE_S * 1e9), "it does not answer"
        while clock.now_ns() < until_ns:
            await asyncio.sleep(LOOK_S)
            try:
                told = await self._lines.errands.send(robot, ROTATED, {}, patience_s=GRANT_PATIENCE_S)
            except RefusedError as error:
                trouble = str(error)
                continue
            if not told.get("under_way"):
                refuse(str(told.get("refusal", "")))
                return dict(told["answer"])
        raise RefusedError(f"it is not known whether {robot} has replaced its key: {trouble}; failover team list there tells")

    async def _ordered_to_rotate(self, peer: str, _arguments: dict[str, Any]) -> dict[str, Any]:
        log.info("%s has this robot replace its key", peer)
        self._rotation = await self._begun(self._rotated())
        return {}

    async def _how_far(self, _peer: str, _arguments: dict[str, Any]) -> dict[str, Any]:
        work = self._rotation
        if work is None:
            return {"refusal": "its agent was started anew meanwhile; give the command again, it goes on where it was"}
        if not work.done():
            return {"under_way": True}
        error = work.exception()
        return {"refusal": str(error)} if error is not None else {"answer": work.result()}

    # --- how things stand ---

    async def _may_live(self, robot: str) -> bool:
        """Whether a member is heard, or may be on its way still. One of another site is never heard: is it connected?"""
        if self._lines.settings.is_far(robot):
            return not self._lines.hindrance(robot)
        status = (await self._lines.ask("status")).status
        return status is None or any(_may_live(peer) for peer in status.peers if peer.robot == robot)

    async def _objection(self, robot: str, after: Team) -> str:
        """Why a member cannot be taken out now, as seen from here; "" where nothing is against it."""
        status = (await self._lines.ask("status")).status
        if status is None:
            return "its agent is starting; try again"
        if self._lines.settings.is_far(robot):
            return ""  # it objects itself where it can be asked, and the members of its site do
        peer = next((one for one in status.peers if one.robot == robot), None)
        lives = peer is not None and _may_live(peer)
        before = self._lines.settings.team.robots
        if (
            not lives
            and self._lines.settings.config.rule == "etcd"
            and before[robot].role == "robot"
            and acts_unheard(sum(one.site == before[robot].site for one in before.values()))
        ):
            return (
                f"nobody hears {robot}, which may act by etcd's vote all the same. Bring it back, then take it out. If it is "
                'lost for good, see "A robot that is lost for good" in docs/coordinator.md'
            )
        living = {self._lines.settings.config.robot, *(one.robot for one in status.peers if one.state in ALIVE)}
        open_ones = [one for one in status.components if one.state not in ENDED]
        if lives and (runs := [one.name for one in open_ones if one.primary == robot]):
            return f"{robot} runs {', '.join(runs)}: move them first, failover handover NAME"
        if lives and (hindrance := self._lines.hindrance(robot)):
            return f"{robot} lives and cannot be told that it is taken out: {hindrance}; stop its agent first"
        others = {name for name, one in after.at_site(self._lines.settings.me.site).items() if one.role != "witness"}
        protects = [one.name for one in open_ones if one.standby == robot and others - {one.primary}]
        if lives and protects:
            return (
                f"{robot} holds the newest checkpoint of {', '.join(protects)}: stop its agent, wait until failover status names "
                "another standby, then take it out"
            )
        alone = [one.name for one in open_ones if robot in (one.primary, one.standby) and one.primary not in living - {robot}]
        patience_ns = int(self._lines.settings.config.patience_s * 1e9)
        if alone and peer is not None and peer.silent_ns < patience_ns:
            return (
                f"{robot} alone may hold the newest checkpoint of {', '.join(alone)}, which no robot runs now: wait until one "
                f"does, or until {robot} was silent for patience_s, {self._lines.settings.config.patience_s:g} s"
            )
        return ""

    # --- granted to another robot, taken from it ---

    async def _granted(self, peer: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """May that robot make this change? An answer, not a refusal: whoever does not answer is away."""
        asked = arguments_of(TakenTeam, "team_grant", arguments)
        me, before = self._lines.settings.config.robot, self._lines.settings.team
        if self._busy.locked() or self._taking.locked():
            return {"refusal": f"{me} changes the team itself now: try again"}
        try:
            after = team_of(asked, before)
            check_team(self._lines.settings, after)
            self.check_that_it_can_be_written()
        except (FailoverError, AgentError) as error:
            return {"refusal": str(error)}
        if asked.have == before.change:
            who = step(_who(before), _who(after))
            if not who or asked.proposer != peer or after.change != before.change + 1:
                return {"refusal": f"it has other members than {peer}: copy the same team.toml to both"}
        else:
            who = ""
        if who in before.robots and who in after.robots and not _is_own_rotation(peer, who, before, after):
            return {"refusal": f"{who} alone may replace its key, and nothing else of its entry"}
        removed = who if who not in after.robots else ""
        if removed and (objection := await self._objection_to(removed, after)):
            return {"refusal": objection}
        refusal = self._grants.ask(self._lines.settings.team.change, asked.have, peer, clock.now_ns(), digest(after.robots))
        sees = bool(removed) and removed != me and await self._may_live(removed)
        told = (await self._lines.ask("elections")).elections
        return {
            "refusal": refusal,
            "sees": sees,
            "members": digest(after.robots),
            "rule": self._lines.settings.config.rule,
            "elections": msgspec.to_builtins(told),
        }

    async def _objection_to(self, removed: str, after: Team) -> str:
        if removed != self._lines.settings.config.robot:
            return await self._objection(removed, after)
        runs = await self._held_here()
        return f"it runs {', '.join(runs)}: move them first, failover handover NAME" if runs else ""

    async def _held_here(self) -> list[str]:
        status = (await self._lines.ask("status")).status
        me = self._lines.settings.config.robot
        return [one.name for one in status.components if one.state in HOLDING and one.primary == me] if status else []

    async def _let_go(self, peer: str, _arguments: dict[str, Any]) -> dict[str, Any]:
        self._grants.done(peer)
        return {}

    async def _is(self, _peer: str, _arguments: dict[str, Any]) -> dict[str, Any]:
        """The team that this robot has."""
        team = self._lines.settings.team
        return {"change": team.change, "members": digest(team.robots)}

    async def _taken(self, peer: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """The team as it is now: believed where this robot has granted it, or the others that it reaches have it."""
        told = arguments_of(TakenTeam, "team_taken", arguments)
        if self._busy.locked():
            raise RefusedError(f"{self._lines.settings.config.robot} changes the team itself now: try again")
        after = team_of(told, self._lines.settings.team)
        members = digest(after.robots)
        if self._is_known(after):
            return {"change": self._lines.settings.team.change}
        is_granted = self._grants.covers(peer, members) and after.change == self._lines.settings.team.change + 1
        if not is_granted:
            await self._check_with_the_others(peer, after.change, members)
        async with self._taking:
            if self._is_known(after):  # another one has told it meanwhile, or a later one
                return {"change": self._lines.settings.team.change}
            check_team(self._lines.settings, after)
            has_other_keys = self._has_other_keys(peer, after)
            if self._lines.settings.config.robot not in after.robots:
                await self._leave(after, peer, is_ordered=is_granted)
            else:
                await asyncio.to_thread(self._write, after)
                await self._lines.take_team(after)
            self._grants = Grants()  # of a change with this number, which is made now
        if has_other_keys:
            await self.until_reached(peer)  # the answer takes a new connection
        return {"change": after.change}

    def _is_known(self, after: Team) -> bool:
        """Whether this robot has that team. Raises RefusedError: it has another one, or a later one."""
        before = self._lines.settings.team
        if after.team != before.team or after.change < before.change:
            raise RefusedError(f"it has change {before.change} of team {before.team}")
        if after.robots == before.robots:
            return True
        if after.change == before.change:
            raise RefusedError(f"it has another change {before.change} of the team")
        return False

    async def _check_with_the_others(self, peer: str, change: int, members: int) -> None:
        """One robot's word is not enough: a single stolen key would dissolve the team.

        Raises:
            RefusedError: another member that is reached does not have it (yet), or too few are reached.
        """
        settings = self._lines.settings
        reached = [one for one in settings.others if one != peer and not self._lines.hindrance(one)]
        for one in reached:
            answer = await self._lines.errands.send(one, TEAM_IS, {}, patience_s=GRANT_PATIENCE_S)
            if (answer.get("change"), answer.get("members")) != (change, members):
                raise RefusedError(f"{one} does not have change {change} of the team")
        witnesses = {name for name, one in settings.team.robots.items() if one.role == "witness"}
        who = {settings.config.robot, peer, *reached} & set(settings.team.robots)
        if len(who) < len(settings.team.robots) // 2 + 1 or not ({peer, *reached} - witnesses):
            raise RefusedError(f"only {peer} tells of change {change} of the team, and too few other members can be asked")

    async def _leave(self, after: Team, by: str, *, is_ordered: bool) -> None:
        """This robot belongs to the team no more: its agent ends, so that it takes nothing over.

        Raises:
            RefusedError: it was asked, and has taken a program over since. A robot that was taken out as lost is not asked: the
                team goes on without its copies, and they end.
        """
        runs = await self._held_here()
        if runs and is_ordered:
            self._grants.done(by)
            raise RefusedError(f"it runs {', '.join(runs)}: move them first, failover handover NAME")
        for name in runs:
            await self._lines.command(functools.partial(_stop, name))
        await asyncio.to_thread(self._write, after)
        log.critical("%s was taken out of team %s; its agent ends", self._lines.settings.config.robot, after.team)
        asyncio.get_running_loop().call_later(LEAVE_S, end_agent)

    def _has_other_keys(self, peer: str, after: Team) -> bool:
        before = self._lines.settings.team.robots
        return peer in before and peer in after.robots and before[peer].keys != after.robots[peer].keys

    # --- the file ---

    def check_that_it_can_be_written(self) -> None:
        """Raises RefusedError: the team's file cannot."""
        directory = Path(self._lines.settings.config.team_directory)
        if not os.access(directory, os.W_OK):
            raise RefusedError(f"it cannot write into {directory}; a service needs ReadWritePaths={directory}")

    def _write(self, after: Team) -> None:
        directory = Path(self._lines.settings.config.team_directory)
        try:
            team_file.write(directory, after)
        except OSError as error:
            raise RefusedError(
                f"cannot write {directory / team_file.TEAM_FILE}: {error.strerror}; a service needs ReadWritePaths={directory}"
            ) from error


def _waits(before: Team, after: Team, told: Mapping[str, Answer]) -> str:
    """Which elections a change must wait for, as a part of a sentence; "" for none. Each site elects for itself."""
    if before.robots.keys() == after.robots.keys():
        return ""
    waits = []
    for site in sorted({one.site for one in after.robots.values()}):
        members, voters = before.at_site(site), after.at_site(site)
        answers = {name: answer for name, answer in told.items() if name in members}
        rule = next((answer.rule for answer in answers.values() if answer.rule), "auto")
        if is_by_pair(rule, len(voters)):
            continue
        known = {name: answer.elections for name, answer in answers.items()}
        for component, (epoch, lacking) in unaware(members, voters, known, with_etcd=rule == "etcd").items():
            names = ", ".join(one for one in lacking if one in members)
            waits.append(f"{names}: not told yet which robot runs {component} in epoch {epoch}")
    return "; ".join(waits)


def _is_own_rotation(peer: str, who: str, before: Team, after: Team) -> bool:
    from failover.config.members import is_rotation  # here: as above

    return peer == who and is_rotation(before.robots[who], after.robots[who])


def _stop(name: str, number: int) -> events.Command:
    return events.Stop(number, name)


def end_agent() -> None:
    """End the main loop that started this process, as systemd would."""
    os.kill(os.getppid(), signal.SIGTERM)


def refuse(objection: str) -> None:
    """Raises RefusedError: there is one."""
    if objection:
        raise RefusedError(objection)


def _may_live(peer: PeerView) -> bool:
    return peer.state in (*ALIVE, RESTARTING) or (peer.state == "unheard" and peer.silent_ns < UNHEARD_NS)


def _note_refusal(work: asyncio.Task[dict[str, Any]]) -> None:
    """Its client may have gone."""
    if not work.cancelled() and (error := work.exception()) is not None:
        log.info("the team was not changed: %s", error)


def _wanted(before: Team, wanted: TeamArguments, me: str) -> Team:
    """Raises RefusedError: there can be no such team."""
    from failover.config.members import joined, left  # here: a worker that changes no team does not load them

    try:
        if wanted.act == "remove":
            return left(before, wanted.robot, me)
        if wanted.member is None:
            raise RefusedError(f"the addresses and the key of {wanted.robot} are missing")
        return joined(before, wanted.robot, wanted.member)
    except FailoverError as error:
        raise RefusedError(str(error), type(error).__name__) from error


def team_of(told: TakenTeam, before: Team) -> Team:
    """The team that was told; the board is this robot's own.

    Raises:
        RefusedError: it could not be written as a team file.
    """
    try:
        team = Team(told.team, dict(told.robots), before.board, told.change, told.next_seat, dict(told.former))
        team_file.check_team("a change of the team", team)
    except FailoverError as error:
        raise RefusedError(str(error), type(error).__name__) from error
    return team


def _who(team: Team) -> dict[str, tuple[object, ...]]:
    """What tells members apart: all but their seats, which all get with the first change."""
    return {name: (one.beats, one.bulk, one.role, one.public_key, one.next_key, one.site) for name, one in team.robots.items()}


def told_of(team: Team) -> dict[str, Any]:
    """A team as it travels to another member."""
    told: dict[str, Any] = msgspec.to_builtins(
        TakenTeam(team.team, team.change, team.robots, next_seat=team.next_seat, former=team.former)
    )
    return told


def digest(robots: Mapping[str, Robot]) -> int:
    """By which two robots find out that they have different teams."""
    told = {name: msgspec.to_builtins(robots[name]) for name in sorted(robots)}
    for one in told.values():
        if not one["next_key"]:
            del one["next_key"]  # a release that knows none has the same digest
        if not one["site"]:
            del one["site"]  # the same
    content = msgspec.json.encode(told)
    return int.from_bytes(blake2b(content, digest_size=4).digest(), "big")
