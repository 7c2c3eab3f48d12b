"""Members join and leave while the agents work: asked for here, granted to another robot, taken from it.

The rule is `failover.core.team_changes`: one member at a time, each change with the grants of a majority. Here are the acts:
asking the others, the team file, and, by `Lines.take_team`, the links and the main loop. No agent starts anew.
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
from collections.abc import Mapping
from hashlib import blake2b
from pathlib import Path
from typing import Any, Final, Protocol

import msgspec

from agent.config import Settings, check_team
from agent.errors import AgentError, RefusedError
from agent.main_loop.messages import Told
from agent.system import clock
from agent.system.permissions import may
from agent.worker.control.arguments import TakenTeam, TeamArguments, arguments_of
from agent.worker.control.server import Conversation
from agent.worker.network.remote_orders import Errands, Order
from failover.config import team as team_file
from failover.config.team import Robot, Team
from failover.core.team_changes import USE_NS, Grants, missing, step
from failover.core.types import ENDED, HOLDING
from failover.errors import FailoverError

GRANT_PATIENCE_S: Final = 15.0
"""A member that does not answer in this time counts as one that cannot be reached."""

BEHIND_S: Final = 1.0
"""Between two looks for members that have not taken the newest change yet."""

LEAVE_S: Final = 0.5
"""So long after its answer a robot that was taken out ends its agent: the answer is on its way by then."""

ALIVE: Final = ("alive", "suspect")

log = logging.getLogger("failover.lanes")


class Lines(Protocol):
    """What of `agent.worker.hub.Switchboard` is needed here."""

    settings: Settings
    errands: Errands

    async def ask(self, what: Any) -> Told: ...
    def hindrance(self, peer: str) -> str: ...
    async def take_team(self, team: Team) -> None: ...


class TeamChanges:
    """The changes of the team, as one member sees them. Lives in the worker's loop.

    Attributes:
        conflicts: peer → sentence: it has another change with the same number.
    """

    def __init__(self, lines: Lines) -> None:
        self._lines = lines
        self._grants = Grants()
        self._busy = asyncio.Lock()
        self._behind: dict[str, int] = {}
        self.conflicts: dict[str, str] = {}

    def errands(self) -> dict[str, Order]:
        """What another robot may order."""
        return {"team_grant": self._granted, "team_taken": self._taken, "team_let_go": self._let_go}

    def heard(self, peer: str, change: int, members: int) -> None:
        """A peer says on a new connection how often its team was changed."""
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
        """Members that were away get the newest change as soon as they are back."""
        while True:
            await asyncio.sleep(BEHIND_S)
            for peer in list(self._behind):
                if peer not in self._lines.settings.peers or self._lines.settings.me.role == "witness":
                    self._behind.pop(peer, None)  # an order of a witness is refused: it may be any user's process
                elif not self._lines.hindrance(peer):
                    await self._told(peer, self._lines.settings.team)

    # --- asked for here ---

    async def verb(self, say: Conversation, arguments: dict[str, Any]) -> dict[str, Any]:
        """Change the team, for root: see `failover.client.control`."""
        wanted = arguments_of(TeamArguments, "team", arguments)
        if not may(say.caller.uid, None):
            raise RefusedError("only root may change the team", "PermissionError")
        if self._busy.locked():
            raise RefusedError("another change of the team is under way at this robot; wait for it")
        async with self._busy:
            try:
                return await self._change(wanted)
            except FailoverError as error:
                raise RefusedError(str(error), type(error).__name__) from error
            finally:
                self._grants.done()

    async def _change(self, wanted: TeamArguments) -> dict[str, Any]:
        settings, before = self._lines.settings, self._lines.settings.team
        me, removed = settings.config.robot, wanted.robot if wanted.act == "remove" else ""
        after = _wanted(before, wanted, me)
        check_team(settings, after)
        if removed:
            await self._check_that_it_may_leave(removed)
        await self._be_granted(before, after, removed)
        if removed and not self._lines.hindrance(removed):
            await self._lines.errands.send(removed, "team_taken", told_of(after), patience_s=GRANT_PATIENCE_S)
        await asyncio.to_thread(self._write, after)
        others = [peer for peer in settings.peers if peer != removed]
        done = await asyncio.gather(*(self._told(peer, after) for peer in others))
        await self._lines.take_team(after)
        waiting = [peer for peer, took in zip(others, done, strict=True) if not took]
        self._behind = dict.fromkeys(waiting, before.change)
        return {"team": after.team, "robots": sorted(after.robots), "change": after.change, "waiting": waiting}

    async def _be_granted(self, before: Team, after: Team, removed: str) -> None:
        """Raises RefusedError: a member refuses, or too few can be asked; nothing has changed."""
        me, asked_ns = self._lines.settings.config.robot, clock.now_ns()
        if refusal := self._grants.ask(before.change, before.change, me, asked_ns):
            raise RefusedError(f"cannot change the team at {me}: {refusal}")
        others = [peer for peer in self._lines.settings.peers if peer != removed]
        answers = await asyncio.gather(*(self._asked(peer, before, after) for peer in others))
        granted = {me, *(peer for peer, (granted, _) in zip(others, answers, strict=True) if granted)}
        refusals = [sentence for peer, (_, sentence) in zip(others, answers, strict=True) if sentence]
        silent = [peer for peer, (granted, why) in zip(others, answers, strict=True) if not granted and not why]
        short = missing(before.robots, granted, removed)
        if refusals or short or clock.now_ns() - asked_ns > USE_NS:
            self._grants.done()
            await asyncio.gather(*(self._free(peer) for peer in granted - {me}))
            if refusals:
                raise RefusedError(f"cannot change the team: {'; '.join(refusals)}")
            raise RefusedError(
                f"cannot change the team: {short} more of its {len(before.robots)} members must agree, and "
                f"{', '.join(silent) or 'they'} cannot be reached in time; nothing has changed"
            )

    async def _asked(self, peer: str, before: Team, after: Team) -> tuple[bool, str]:
        """(it grants the change, why it refuses); (False, "") where it cannot be reached."""
        if self._lines.hindrance(peer):
            return False, ""
        question = told_of(after) | {"proposer": self._lines.settings.config.robot, "have": before.change}
        try:
            answer = await self._lines.errands.send(peer, "team_grant", question, patience_s=GRANT_PATIENCE_S)
        except RefusedError as error:
            log.info("%s does not answer about the team: %s", peer, error)
            return False, ""
        refusal = str(answer.get("refusal", ""))
        return not refusal, f"{peer}: {refusal}" if refusal else ""

    async def _free(self, peer: str) -> None:
        try:
            await self._lines.errands.send(peer, "team_let_go", {}, patience_s=GRANT_PATIENCE_S)
        except RefusedError as error:
            log.info("the grant of %s ends by itself: %s", peer, error)

    async def _told(self, peer: str, team: Team) -> bool:
        """Whether a member has taken the change."""
        if self._lines.hindrance(peer):
            return False
        try:
            await self._lines.errands.send(peer, "team_taken", told_of(team), patience_s=GRANT_PATIENCE_S)
        except RefusedError as error:
            log.warning("%s has not taken change %d of the team: %s", peer, team.change, error)
            return False
        self._behind.pop(peer, None)
        return True

    async def _check_that_it_may_leave(self, robot: str) -> None:
        """A robot that lives must hear of it, and runs nothing: else its programs would run on without the team.

        Raises:
            RefusedError: it runs something, or cannot be told.
        """
        status = (await self._lines.ask("status")).status
        state = next((peer.state for peer in status.peers if peer.robot == robot), "") if status else ""
        runs = [one.name for one in status.components if one.primary == robot and one.state not in ENDED] if status else []
        if state not in ALIVE:
            return
        if runs:
            raise RefusedError(f"{robot} runs {', '.join(runs)}: move them first, failover handover NAME")
        if hindrance := self._lines.hindrance(robot):
            raise RefusedError(f"{robot} lives and cannot be told that it is taken out: {hindrance}; stop its agent first")

    # --- granted to another robot, taken from it ---

    async def _granted(self, arguments: dict[str, Any], _by: int) -> dict[str, Any]:
        """May that robot make this change? An answer, not a refusal: whoever does not answer is away."""
        asked = arguments_of(TakenTeam, "team_grant", arguments)
        if self._busy.locked():
            return {"refusal": f"{self._lines.settings.config.robot} changes the team itself now: try again"}
        try:
            check_team(self._lines.settings, team_of(asked, self._lines.settings.team))
        except AgentError as error:  # of what was asked, too
            return {"refusal": str(error)}
        have = self._lines.settings.team.change
        refusal = self._grants.ask(have, asked.have, asked.proposer, clock.now_ns())
        if not refusal and not step(_who(self._lines.settings.team), _who(team_of(asked, self._lines.settings.team))):
            self._grants.done()
            return {"refusal": f"it has other members than {asked.proposer}: copy the same team.toml to both"}
        return {"refusal": refusal}

    async def _let_go(self, _arguments: dict[str, Any], _by: int) -> dict[str, Any]:
        self._grants.done()
        return {}

    async def _taken(self, arguments: dict[str, Any], _by: int) -> dict[str, Any]:
        """The team as it is now."""
        told = arguments_of(TakenTeam, "team_taken", arguments)
        before = self._lines.settings.team
        after = team_of(told, before)
        if after.team != before.team or after.change < before.change:
            raise RefusedError(f"it has change {before.change} of team {before.team}")
        if after.robots == before.robots:
            return {"change": before.change}
        if after.change == before.change:
            raise RefusedError(f"it has another change {before.change} of the team")
        check_team(self._lines.settings, after)
        if self._lines.settings.config.robot not in after.robots:
            await self._leave(after)
        else:
            await asyncio.to_thread(self._write, after)
            await self._lines.take_team(after)
        self._grants.done()
        return {"change": after.change}

    async def _leave(self, after: Team) -> None:
        """This robot belongs to the team no more: its agent ends, so that it takes nothing over."""
        status = (await self._lines.ask("status")).status
        if status is not None and (runs := [one.name for one in status.components if one.state in HOLDING]):
            raise RefusedError(f"it runs {', '.join(runs)}: move them first, failover handover NAME")
        await asyncio.to_thread(self._write, after)
        log.critical("%s was taken out of team %s; its agent ends", self._lines.settings.config.robot, after.team)
        asyncio.get_running_loop().call_later(LEAVE_S, os.kill, os.getppid(), signal.SIGTERM)

    def _write(self, after: Team) -> None:
        directory = Path(self._lines.settings.config.team_directory)
        try:
            team_file.write(directory, after)
        except OSError as error:
            raise RefusedError(
                f"cannot write {directory / team_file.TEAM_FILE}: {error.strerror}; a service needs ReadWritePaths={directory}"
            ) from error


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
        team = Team(told.team, dict(told.robots), before.board, told.change)
        team_file.check_team("a change of the team", team)
    except FailoverError as error:
        raise RefusedError(str(error), type(error).__name__) from error
    return team


def _who(team: Team) -> dict[str, tuple[object, ...]]:
    """What tells members apart: all but their seats, which all get with the first change."""
    return {name: (one.beats, one.bulk, one.role, one.public_key) for name, one in team.robots.items()}


def told_of(team: Team) -> dict[str, Any]:
    """A team as it travels to another member."""
    told: dict[str, Any] = msgspec.to_builtins(TakenTeam(team.team, team.change, team.robots))
    return told


def digest(robots: Mapping[str, Robot]) -> int:
    """By which two robots find out that they have different teams."""
    content = msgspec.json.encode({name: robots[name] for name in sorted(robots)})
    return int.from_bytes(blake2b(content, digest_size=4).digest(), "big")
