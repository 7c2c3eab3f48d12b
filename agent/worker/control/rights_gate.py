"""Asks the rules of rights who may do what, for each verb of the control socket and each order of another robot.

Without rights.toml the rights of `agent.system.permissions` hold, and nothing here is asked. The file is read again when it has
changed. One with a mistake gives no right to any user but root and the agent's own, who can mend it.
"""

from __future__ import annotations

import asyncio
import time
from datetime import datetime
from pathlib import Path
from typing import Final

from msgspec.structs import replace

from agent.directory.client import DirectoryProcess
from agent.directory.messages import Question, spelled_age
from agent.errors import RefusedError
from agent.system.permissions import may
from failover.config import accounts
from failover.config.rights import Rights, RightsFile
from failover.core.rights import hours
from failover.core.rights.rules import NEVER_BY_DEFAULT, Decision, Subject, decide
from failover.errors import RightsError

RIGHT_OF: Final = {
    "ping": "see",
    "status": "see",
    "why": "see",
    "rights": "see",
    "may": "see",
    "logs": "read",
    "run": "start",
    "protect": "start",
    "handover": "operate",
    "failback": "operate",
    "prefer": "operate",
    "promote": "operate",
    "drain": "operate",
    "release": "operate",
    "start": "operate",
    "stop": "operate",
    "reserve": "operate",
    "unreserve": "see",
}
"""Verb of the control socket → right that it needs."""


class RightsGate:
    """The rules of one robot."""

    def __init__(self, team_directory: Path, state_directory: Path, starter: str = "") -> None:
        """
        Args:
            starter: of services of their own, for the process that asks the directory.
        """
        self._file = RightsFile(team_directory)
        self._places = team_directory, state_directory, starter
        self._directory: DirectoryProcess | None = None
        self._answered_at: float | None = None
        self._away = ""

    @property
    def has_rules(self) -> bool:
        """Whether there is a file of rules, mistaken or not."""
        self._look()
        return self._file.exists

    async def subject(self, uid: int, verb: str) -> Subject:
        """Who a user of this robot, or one that another robot vouches for, is.

        Raises:
            RefusedError: who it is cannot be known now; so no right is given, for a rule that denies may be about it.
        """
        found = self._look()
        if may(uid, None) and verb not in NEVER_BY_DEFAULT:
            return Subject(
                f"uid:{uid}", uid=uid, stands_above=True
            )  # asks no directory: the robot's own console works without a network
        if found is None:
            raise RefusedError(f"no right can be given: {self._file.mistake or 'there are no rules'}", "PermissionError")
        config = found.config
        if config.source == "file":
            subject = await asyncio.to_thread(accounts.subject_of, uid, config.groups)
            return replace(subject, stands_above=may(uid, None))
        return await self._by_directory(await asyncio.to_thread(accounts.name_of, uid), uid, verb)

    async def explained(self, user: str, verb: str, path: str, owner: int | None) -> tuple[Decision, Subject]:
        """May a user, named as the robot's accounts or the directory name it, do this; and who that is.

        Raises:
            RefusedError: who it is cannot be known.
        """
        uid = await asyncio.to_thread(accounts.uid_of, user)
        if uid is not None:
            subject = await self.subject(uid, verb)
        elif (found := self._file.rights) is None or found.config.source == "file":
            raise RefusedError(f"this robot has no user {user!r}; see getent passwd", "RightsError")
        else:
            subject = await self._by_directory(user, None, verb)
        return self.decision(subject, verb, path, owner), subject

    def standing(self) -> str:
        """One sentence for the status: by which rules and whose groups rights are decided, what is wrong; "" without a file."""
        if not self.has_rules:
            return ""
        found = self._file.rights
        if found is None:
            return f"no user but root has any: {self._file.mistake}; mend the file, failover-agent check names the next mistake"
        config, many = found.config, len(found.rules)
        told = f"{many} rule{'s' * (many != 1)} of {self._file.path}; groups"
        if config.source == "file":
            return f"{told} of this machine"
        told = f"{told} by {config.ldap.server}"
        ago = spelled_age(time.monotonic() - self._answered_at) if self._answered_at is not None else None
        if not self._away:
            return f"{told}, {'not asked yet' if ago is None else f'which answered {ago} ago'}"
        since = f"for {ago}" if ago is not None else "since the agent began, or the file changed"
        copies = f"copies of {config.ldap.cache_h} h at most serve" if config.ldap.cache_h else "no copy serves (cache_h = 0)"
        but = "" if config.ldap.offline_program else ", never for program and grant"
        return f"{told}, which has not answered {since} ({self._away}): {copies}{but}; start the server, or mend [rights.ldap]"

    def decision(self, subject: Subject, verb: str, path: str, owner: int | None) -> Decision:
        """May this subject do this there?

        Args:
            owner: uid of whose the component is; None: it is not known.
        """
        rules = self._file.rights.rules if self._file.rights is not None else ()
        now = datetime.now()
        minute = hours.minute_of(now.weekday(), now.hour, now.minute)
        try:
            return decide(rules, replace(subject, is_owner=owner is not None and subject.uid == owner), verb, path, minute)
        except RightsError as error:
            return Decision(False, str(error))

    async def check(self, uid: int, verb: str, path: str, owner: int | None = None) -> None:
        """Let a user do something.

        Raises:
            RefusedError: the rules say no; with the sentence why.
        """
        answer = self.decision(await self.subject(uid, verb), verb, path, owner)
        if not answer:
            raise RefusedError(answer.because, "PermissionError")

    def close(self) -> None:
        """End the process that asks the directory."""
        if self._directory is not None:
            self._directory.close()
            self._directory = None

    async def _by_directory(self, name: str, uid: int | None, verb: str) -> Subject:
        """A user by its name in the directory; ``uid``: its number on this robot, None where it has no account here."""
        is_above = uid is not None and may(uid, None)
        if not name:
            return Subject(f"uid:{uid}", uid=uid, stands_above=is_above)
        if self._directory is None:
            self._directory = DirectoryProcess(*self._places)
        answer = await self._directory.ask(Question(name, verb))
        self._away = answer.away
        if not answer.away:
            self._answered_at = time.monotonic() - answer.age_s
        if answer.refusal and (uid is None or not answer.is_stranger):
            raise RefusedError(f"no right can be given to {name}: {answer.refusal}", "PermissionError")
        named = f"uid:{uid}" if answer.is_stranger else f"ldap:{name}"
        return Subject(named, frozenset(answer.groups), uid=uid, stands_above=is_above, copy=answer.copy)

    def _look(self) -> Rights | None:
        """The rules as they are now; None: there are none, or they are mistaken."""
        if self._file.look():
            self.close()  # it has read the older one
            self._answered_at, self._away = None, ""
        return self._file.rights
