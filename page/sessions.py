"""Who looks: sessions with their cookie and token.

On the loopback the kernel tells whose program has connected (`page.loopback_user`), and a session belongs to that user. With
``[users]`` in page.toml a session begins with a name and a password (`page.passwords`).
"""

from __future__ import annotations

import hmac
import secrets
import time

from page.errors import TurnedAwayError
from page.limits import (
    ORDERS_A_S,
    ORDERS_AT_ONCE,
    PAGE_SESSIONS_MAX,
    SESSION_MAX_S,
    SESSION_S,
    SESSIONS_OF_USER_MAX,
)
from page.rate import Rate


class Session:
    """One browser of one user.

    Attributes:
        user: the name that others see. uid: on whose behalf the agent is asked; None: the page's own user.
        peer: the user of this robot whose program has begun it; None: it came over a network.
        token: what a POST must carry. live: WebSockets that are open.
    """

    def __init__(self, user: str, uid: int | None, peer: int | None = None) -> None:
        self.id = secrets.token_urlsafe(32)
        self.token = secrets.token_urlsafe(32)
        self.user = user
        self.uid = uid
        self.peer = peer
        self.began_s = self.seen_s = time.monotonic()
        self.live = 0
        self.orders = Rate(ORDERS_A_S, ORDERS_AT_ONCE)

    def is_token(self, token: str) -> bool:
        """Whether a POST comes from this session's own page."""
        return hmac.compare_digest(token.encode(), self.token.encode())


class Sessions:
    """All that there are."""

    def __init__(self) -> None:
        self._sessions: dict[str, Session] = {}

    def __len__(self) -> int:
        return len(self._sessions)

    def of(self, cookie: str) -> Session | None:
        """The session of a cookie, if it is not over; it lives on for a while then."""
        session = self._sessions.get(cookie)
        if session is None or self.is_over(session):
            return None
        session.seen_s = time.monotonic()
        return session

    def is_over(self, session: Session) -> bool:
        """Whether it has ended, or ends now."""
        now_s = time.monotonic()
        is_idle = now_s - session.seen_s > SESSION_S and not session.live
        if is_idle or now_s - session.began_s > SESSION_MAX_S:
            self.end(session)
        return session.id not in self._sessions

    def begin(self, user: str, uid: int | None, peer: int | None = None) -> Session:
        """A new one; the oldest that no window uses makes room.

        Raises:
            TurnedAwayError: all are in use.
        """
        own = [one for one in self._sessions.values() if (one.user, one.uid) == (user, uid)]
        self._make_room(own, SESSIONS_OF_USER_MAX, f"{user} has")
        self._make_room(list(self._sessions.values()), PAGE_SESSIONS_MAX, "this page has")
        session = Session(user, uid, peer)
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
