"""Answers about users: from the server, from what it said a moment ago, or from a copy on the disk while it is away.

A copy never gives ``program`` and ``grant`` (unless ``offline_program``), and never takes a password that the server did not.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import os
from collections.abc import Callable
from pathlib import Path
from typing import Final, Protocol

import msgspec

from agent.directory.messages import Answer, Question, spelled_age
from agent.directory.server import EMPTY_PASSWORD, UnknownUserError, WrongPasswordError
from agent.errors import DirectoryError
from checkpoint.errors import UNDECODABLE
from checkpoint.store.whole_file import write_whole
from failover.config.rights import LdapConfig
from failover.core.rights.rules import NEVER_BY_DEFAULT

COPIES_MAX: Final = 4_096
"""Users of one robot; the oldest copy goes first."""

ORIGINS_MAX: Final = 4_096
"""(user, origin) with wrong passwords that are remembered; the oldest goes first."""

FREE_TRIES: Final = 3
DELAY_S_MAX: Final = 60.0
"""After `FREE_TRIES` wrong passwords each further one doubles the wait, from 1 s to this."""

AWAY_S: Final = 5.0
"""How long a server that did not answer is not asked again, where a copy serves."""

SCRYPT: Final = {"n": 1 << 14, "r": 8, "p": 1}
"""16 MiB and about 50 ms. Source: RFC 7914 section 2."""


class Server(Protocol):
    """What of `agent.directory.server.LdapServer` is needed here."""

    def groups(self, user: str, password: str | None) -> frozenset[str]: ...


class Copy(msgspec.Struct, frozen=True):
    """What the server last said of a user. ``at``: seconds since 1970; ``salt``, ``digest``: "" where no password was tried."""

    groups: tuple[str, ...]
    at: float
    salt: bytes = b""
    digest: bytes = b""

    def takes(self, password: str | None) -> bool:
        """Whether the server took this password; None: none is asked for."""
        return password is None or (bool(self.digest) and hmac.compare_digest(self.digest, _digest(password, self.salt)))


class Answers:
    """One server's answers.

    Args:
        path: file of the copies, 0600.
        now_s: a clock that only grows; calendar_s: seconds since 1970, for the age of a copy over restarts.
    """

    def __init__(
        self, config: LdapConfig, server: Server, path: Path, now_s: Callable[[], float], calendar_s: Callable[[], float]
    ) -> None:
        self._config = config
        self._server = server
        self._path = path
        self._now_s = now_s
        self._calendar_s = calendar_s
        self._copies = _read(path)
        self._fresh: dict[str, float] = {}
        self._wrong: dict[tuple[str, str], tuple[int, float]] = {}
        self._away: tuple[float, str] = (0.0, "")

    def answer(self, question: Question) -> Answer:
        """Who is it?"""
        user, password, strict = question.user, question.password, question.verb in NEVER_BY_DEFAULT
        if password == "":
            return Answer(refusal=EMPTY_PASSWORD)
        tries, until = self._wrong.get((user, question.origin), (0, 0.0))
        if password is not None and self._now_s() < until:
            return Answer(refusal=f"{tries} wrong passwords of {user}: try again in {until - self._now_s():.0f} s")
        copy = self._copies.get(user)
        if copy and not strict and self._now_s() < self._fresh.get(user, 0.0) and copy.takes(password):
            return Answer(copy.groups, away=self._away[1], age_s=self._calendar_s() - copy.at)
        away, reason = self._away
        if strict or self._now_s() >= away or copy is None:
            try:
                return self._asked(user, password)
            except WrongPasswordError as error:
                return self._counted(question, str(error))
            except UnknownUserError as error:
                self._forget(user)
                return Answer(refusal=str(error), is_stranger=True)
            except DirectoryError as error:
                reason = str(error)
                self._away = (self._now_s() + AWAY_S, reason)
        return self._by_copy(question, copy, reason)

    def _asked(self, user: str, password: str | None) -> Answer:
        groups = tuple(sorted(self._server.groups(user, password)))
        self._away = (0.0, "")
        before = self._copies.get(user)
        salt, digest = (before.salt, before.digest) if before else (b"", b"")
        if password is not None:
            salt = os.urandom(16)
            digest = _digest(password, salt)
            self._wrong = {key: value for key, value in self._wrong.items() if key[0] != user}
        self._copies[user] = Copy(groups, self._calendar_s(), salt, digest)
        self._fresh[user] = self._now_s() + self._config.refresh_s
        while len(self._copies) > COPIES_MAX:
            oldest = min(self._copies, key=lambda name: self._copies[name].at)
            self._copies.pop(oldest)
            self._fresh.pop(oldest, None)
        self._write()
        return Answer(groups)

    def _by_copy(self, question: Question, copy: Copy | None, reason: str) -> Answer:
        """While the server is away."""
        none = "the directory does not answer, and"
        if question.verb in NEVER_BY_DEFAULT and not self._config.offline_program:
            sentence = f"{question.verb} needs a live answer of the directory, and there is none"
            return Answer(refusal=f"{sentence}: {reason}", away=reason)
        if copy is None:
            return Answer(refusal=f"{none} there is no copy of {question.user}: {reason}", away=reason)
        age_s = self._calendar_s() - copy.at
        if not 0 <= age_s <= self._config.cache_h * 3_600:
            why = "from the future: this robot's calendar is wrong" if age_s < 0 else f"older than {self._config.cache_h} h"
            return Answer(refusal=f"{none} the copy of {question.user} is {why}: {reason}", away=reason)
        if not copy.takes(question.password):
            return self._counted(question, f"not the password of {question.user} that the directory last took: {reason}")
        told = f"rights by a copy {spelled_age(age_s)} old, for the directory does not answer: {reason}"
        return Answer(copy.groups, copy=told, away=reason, age_s=age_s)

    def _counted(self, question: Question, sentence: str) -> Answer:
        """One wrong password more."""
        key = question.user, question.origin
        tries = self._wrong.pop(key, (0, 0.0))[0] + 1
        delay_s = min(2.0 ** min(tries - FREE_TRIES, 10), DELAY_S_MAX) if tries >= FREE_TRIES else 0.0
        self._wrong[key] = (tries, self._now_s() + delay_s)
        while len(self._wrong) > ORIGINS_MAX:
            self._wrong.pop(next(iter(self._wrong)))
        return Answer(refusal=sentence)

    def _forget(self, user: str) -> None:
        self._fresh.pop(user, None)
        if self._copies.pop(user, None) is not None:
            self._write()

    def _write(self) -> None:
        """Keep the copies; a disk that takes none costs the copies alone."""
        with contextlib.suppress(OSError):
            write_whole(self._path, msgspec.msgpack.encode(self._copies))


def _read(path: Path) -> dict[str, Copy]:
    """The copies; none where the file is missing, damaged, or may have been written by another user."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
        with open(descriptor, "rb") as file:
            found = os.fstat(descriptor)
            if found.st_uid != os.geteuid() or found.st_mode & 0o077:
                return {}
            return msgspec.msgpack.decode(file.read(), type=dict[str, Copy])
    except (OSError, *UNDECODABLE):
        return {}


def _digest(password: str, salt: bytes) -> bytes:
    return hashlib.scrypt(password.encode("utf-8", "surrogatepass"), salt=salt, dklen=32, **SCRYPT)
