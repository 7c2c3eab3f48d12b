"""Who may call a driver: ``rights.toml`` of the team directory decides, where there is one; asked by the driver for each message.

The kernel says which user of this robot calls. A program of another robot is known by that robot's key, which vouches for the
person in ``by``. Without the file, every caller may that reaches the driver: its own user, root, and the team's robots.
"""

from __future__ import annotations

import os
import time
from datetime import datetime
from pathlib import Path
from typing import Final

from msgspec.structs import replace

from failover.config import accounts
from failover.config.rights import Rights, RightsFile
from failover.core.rights import hours
from failover.core.rights.rules import Decision, Subject, decide
from failover.errors import AgentRefusedError, LostAgentError, NoAgentError, RightsError

RIGHT: Final = "call"

LOOK_NS: Final = 200_000_000
"""How often the file is looked at: so long a right that was taken away holds."""

ANSWER_NS: Final = 1_000_000_000
"""How long an answer of the rules is good: they have hours."""

ANSWER_BY_DIRECTORY_NS: Final = 60_000_000_000
"""The same where the agent had to ask a directory server, and the driver waited for it."""

ANSWERS_MAX: Final = 1_024


class CallRights:
    """The rules for one driver's path."""

    def __init__(self, directory: Path, path: str) -> None:
        """
        Args:
            directory: where ``rights.toml`` may lie.
        """
        self._file = RightsFile(directory)
        self._path = path
        self._looked_ns: int | None = None
        self._answers: dict[tuple[int | None, str | None, str], tuple[str, int]] = {}

    def refusal(self, uid: int | None, robot: str | None, by: str) -> str:
        """Why this caller may not call; "" if it may.

        Args:
            uid: of a caller on this robot. robot: of another one. by: for whom, as that robot says.
        """
        now_ns = time.monotonic_ns()
        if self._looked_ns is None or now_ns - self._looked_ns > LOOK_NS:
            self._looked_ns = now_ns
            if self._file.look():
                self._answers.clear()
        if not self._file.exists:
            return ""
        key = (uid, robot, by if robot is not None else "")
        found = self._answers.get(key)
        if found is None or now_ns > found[1]:
            if len(self._answers) >= ANSWERS_MAX:
                self._answers.clear()
            sentence, is_by_directory = self._asked(uid, robot, by)
            found = sentence, time.monotonic_ns() + (ANSWER_BY_DIRECTORY_NS if is_by_directory else ANSWER_NS)
            self._answers[key] = found
        return found[0]

    def _asked(self, uid: int | None, robot: str | None, by: str) -> tuple[str, bool]:
        """The refusal or "", and whether the agent was asked."""
        if uid == 0:
            return "", False  # root on the robot itself could change the file
        found = self._file.rights
        if found is None:
            return f"no right can be given: {self._file.mistake}", False
        try:
            if robot is not None and not by:
                return self._decided(found, Subject(f"robot:{robot}")), False
            if found.config.source == "ldap":
                return self._by_agent(by if robot is not None else accounts.name_of(uid or 0)), True
            groups = found.config.groups
            if robot is not None:
                person = accounts.subject_named(by, groups)
                return self._decided(found, replace(person, stands_above=False)), False  # root of another robot is not root here
            subject = accounts.subject_of(uid or 0, groups)
            return self._decided(found, replace(subject, is_owner=uid == os.geteuid())), False
        except RightsError as error:
            return str(error), False

    def _decided(self, found: Rights, subject: Subject) -> str:
        now = datetime.now()
        minute = hours.minute_of(now.weekday(), now.hour, now.minute)
        answer: Decision = decide(found.rules, subject, RIGHT, self._path, minute)
        return "" if answer else answer.because

    def _by_agent(self, user: str) -> str:
        """The agent knows the directory server."""
        from failover.client.control import Control  # only where a directory server decides

        try:
            with Control.open() as agent:
                told = agent.ask("rights", user=user, right=RIGHT, path=self._path)
        except (NoAgentError, LostAgentError, AgentRefusedError) as error:
            return f"no right can be given to {user}: the agent asks the directory server, and {error}"
        return "" if told["allow"] else str(told["because"])
