"""Asks the rules of rights who may do what, for each verb of the control socket and each order of another robot.

Without rights.toml the rights of `agent.system.permissions` hold, and nothing here is asked. The file is read again when it has
changed. One with a mistake gives no right to any user but root and the agent's own, who can mend it.
"""

from __future__ import annotations

import asyncio
import os
from datetime import datetime
from pathlib import Path
from typing import Final

from msgspec.structs import replace

from agent.directory.client import DirectoryProcess
from agent.directory.messages import Question
from agent.errors import RefusedError
from agent.system.permissions import may
from failover.config import accounts, rights
from failover.config.rights import Rights
from failover.core.rights import hours
from failover.core.rights.rules import NEVER_BY_DEFAULT, Decision, Subject, decide
from failover.errors import FailoverError, RightsError

RIGHT_OF: Final = {
    "ping": "see",
    "status": "see",
    "why": "see",
    "logs": "read",
    "run": "start",
    "protect": "start",
    "handover": "operate",
    "failback": "operate",
    "prefer": "operate",
    "promote": "operate",
    "release": "operate",
    "stop": "operate",
}
"""Verb of the control socket → right that it needs."""


class RightsGate:
    """The rules of one robot."""

    def __init__(self, team_directory: Path, state_directory: Path, starter: str = "") -> None:
        """
        Args:
            starter: of services of their own, for the process that asks the directory.
        """
        self._path = team_directory / rights.RIGHTS_FILE
        self._places = team_directory, state_directory, starter
        self._read_at: tuple[int, int, int] | None = None
        self._rights: Rights | None = None
        self._mistake = ""
        self._directory: DirectoryProcess | None = None

    @property
    def has_rules(self) -> bool:
        """Whether there is a file of rules, mistaken or not."""
        self._refresh()
        return self._read_at is not None

    async def subject(self, uid: int, verb: str) -> Subject:
        """Who a user of this robot, or one that another robot vouches for, is.

        Raises:
            RefusedError: who it is cannot be known now; so no right is given, for a rule that denies may be about it.
        """
        self._refresh()
        if may(uid, None) and verb not in NEVER_BY_DEFAULT:
            return Subject(
                f"uid:{uid}", uid=uid, stands_above=True
            )  # asks nobody: the robot's own console works without a network
        if self._mistake or self._rights is None:
            raise RefusedError(f"no right can be given: {self._mistake or 'there are no rules'}", "PermissionError")
        config = self._rights.config
        if config.source == "file":
            found = await asyncio.to_thread(accounts.subject_of, uid, config.groups)
            return replace(found, stands_above=may(uid, None))
        return await self._by_directory(uid, verb)

    def decision(self, subject: Subject, verb: str, path: str, owner: int | None) -> Decision:
        """May this subject do this there?

        Args:
            owner: uid of whose the component is; None: it is not known.
        """
        rules = self._rights.rules if self._rights is not None else ()
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

    async def _by_directory(self, uid: int, verb: str) -> Subject:
        name = await asyncio.to_thread(accounts.name_of, uid)
        if not name:
            return Subject(f"uid:{uid}", uid=uid, stands_above=may(uid, None))
        if self._directory is None:
            self._directory = DirectoryProcess(*self._places)
        answer = await self._directory.ask(Question(name, verb))
        if answer.refusal and not answer.is_stranger:
            raise RefusedError(f"no right can be given to {name}: {answer.refusal}", "PermissionError")
        named = f"uid:{uid}" if answer.is_stranger else f"ldap:{name}"
        return Subject(named, frozenset(answer.groups), uid=uid, stands_above=may(uid, None), copy=answer.copy)

    def _refresh(self) -> None:
        """Read the file if it is another one than the last that was read."""
        try:
            found = os.stat(self._path)
            at = (found.st_mtime_ns, found.st_ino, found.st_size)
        except FileNotFoundError:
            at = None
        except OSError as error:
            self._read_at, self._mistake = (0, 0, 0), f"{self._path}: cannot be read: {error.strerror}"
            return
        if at == self._read_at:
            return
        self.close()  # it has read the older one
        self._read_at, self._rights, self._mistake = at, None, ""
        try:
            self._rights = rights.read(self._path.parent)
        except FailoverError as error:
            self._mistake = str(error)
