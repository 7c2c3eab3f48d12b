"""Who looks: sessions with their cookie and token, and logins with a password.

On the loopback the kernel tells whose program has connected (`page.loopback_user`), and a session belongs to that user. With
``[users]`` in page.toml a session begins with a name and a password.
"""

from __future__ import annotations

import hmac
import secrets
import time
from collections import OrderedDict
from collections.abc import Mapping
from typing import Final

from failover.config.page import UserConfig, is_password
from page.errors import TurnedAwayError
from page.limits import (
    ORDERS_A_S,
    ORDERS_AT_ONCE,
    PAGE_SESSIONS_MAX,
    SESSION_S,
    SESSIONS_OF_USER_MAX,
)
from page.rate import Rate

FREE_TRIES: Final = 3
"""Wrong passwords for a name before the next one has to wait …"""

DELAY_MAX_S: Final = 60.0
"""… twice as long each time, up to so long: a person with the right password waits at most this."""

NAMES_MAX: Final = 1_024
"""Names whose wrong passwords are remembered."""

_NO_USER: Final = UserConfig(password="scrypt:16384:8:1:AAAAAAAAAAAAAAAAAAAAAA==:AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA=")
"""A name that there is not takes as long as a wrong password."""


class Session:
    """One browser of one user.

    Attributes:
        user: the name that others see. uid: on whose behalf the agent is asked; None: the page's own user.
        token: what a POST must carry. live: WebSockets that are open.
    """

    def __init__(self, user: str, uid: int | None) -> None:
        self.id = secrets.token_urlsafe(32)
        self.token = secrets.token_urlsafe(32)
        self.user = user
        self.uid = uid
        self.seen_s = time.monotonic()
        self.live = 0
        self.orders = Rate(ORDERS_A_S, ORDERS_AT_ONCE)

    def is_token(self, token: str) -> bool:
        """Whether a POST comes from this session's own page."""
        return hmac.compare_digest(token.encode(), self.token.encode())


class Sessions:
    """All that there are."""

    def __init__(self, users: Mapping[str, UserConfig]) -> None:
        self.users = users
        self._sessions: dict[str, Session] = {}
        self._wrong: OrderedDict[str, tuple[int, float]] = OrderedDict()

    def __len__(self) -> int:
        return len(self._sessions)

    def of(self, cookie: str) -> Session | None:
        """The session of a cookie, if it is not over."""
        session = self._sessions.get(cookie)
        if session is None:
            return None
        now_s = time.monotonic()
        if now_s - session.seen_s > SESSION_S and not session.live:
            self.end(session)
            return None
        session.seen_s = now_s
        return session

    def begin(self, user: str, uid: int | None) -> Session:
        """A new one; the oldest that no window uses makes room.

        Raises:
            TurnedAwayError: all are in use.
        """
        own = [one for one in self._sessions.values() if (one.user, one.uid) == (user, uid)]
        self._make_room(own, SESSIONS_OF_USER_MAX, f"{user} has")
        self._make_room(list(self._sessions.values()), PAGE_SESSIONS_MAX, "this page has")
        session = Session(user, uid)
        self._sessions[session.id] = session
        return session

    def end(self, session: Session) -> None:
        """Its cookie means nothing any more."""
        self._sessions.pop(session.id, None)

    def _make_room(self, among: list[Session], most: int, who: str) -> None:
        if len(among) < most:
            return
        idle = [one for one in among if not one.live]
        if not idle:
            raise TurnedAwayError(503, f"{who} {most} windows open, the most there may be; close one of them", 10)
        self.end(min(idle, key=lambda one: one.seen_s))

    # --- Passwords ---

    def wait_s(self, name: str) -> float:
        """How long the next try for a name must wait."""
        tries, at_s = self._wrong.get(name, (0, 0.0))
        delay_s = min(2.0 ** (tries - FREE_TRIES), DELAY_MAX_S) if tries >= FREE_TRIES else 0.0
        return max(at_s + delay_s - time.monotonic(), 0.0)

    def is_right(self, name: str, password: str) -> bool:
        """Whether it is that user's password; takes a tenth of a second of a thread."""
        user = self.users.get(name)
        return is_password(password, (user or _NO_USER).password) and user is not None and bool(password)

    def note_try(self, name: str, *, right: bool) -> None:
        """A right password ends the waiting; each wrong one makes it longer."""
        tries, _ = self._wrong.pop(name, (0, 0.0))
        if not right:
            self._wrong[name] = tries + 1, time.monotonic()
            if len(self._wrong) > NAMES_MAX:
                self._wrong.popitem(last=False)
