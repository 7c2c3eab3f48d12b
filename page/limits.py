"""Limits of the page, each with its reason."""

from __future__ import annotations

from typing import Final

PAGE_SESSIONS_MAX: Final = 64
"""People and programs that look at once: each may hold a connection to the agent, which gives the page 128."""

SESSIONS_OF_USER_MAX: Final = 16
"""Of these, one user's sessions, and windows: no user shuts another out."""

FEEDS_MAX: Final = 16
"""Users who look at once, however many windows each has: the agent is asked for each of them, by that user's rights."""

BODY_SIZE_MAX: Final = 64 << 10
"""Bytes of a POST: what a driver takes from another robot."""

LIVE_SIZE_MAX: Final = 4 << 10
"""Bytes of a message over the WebSocket: it only names what the user looks at."""

BODY_S: Final = 10.0
"""How long a POST may take from its first byte to its last."""

HEAD_SIZE_MAX: Final = 16 << 10
"""Bytes of the head of a request."""

CONNECTIONS_MAX: Final = 256
"""Open at once, WebSockets among them: the rest of the descriptors are for the agent's socket and the board."""

ORDERS_A_S: Final = 20.0
"""Orders that one session may give a second, in the long run …"""

ORDERS_AT_ONCE: Final = 40
"""… and at once."""

MESSAGES_A_S: Final = 20.0
"""Messages that one WebSocket may send a second, in the long run …"""

MESSAGES_AT_ONCE: Final = 40
"""… and at once."""

LOOK_S: Final = 0.5
"""Between two rows that one client looks at: for each the agents of the team are asked."""

STALE_S: Final = 3.0
"""A picture that is older says so."""

ORDERS_WAITING_MAX: Final = 64
"""Of one user, behind the one that is carried out."""

ORDER_AGE_MAX_S: Final = 15.0
"""From the press of a button until the order is taken: a later one meets a team that its user no longer knows."""

ORDER_WAITS_MAX_S: Final = 60.0
"""Behind the earlier orders of its user, for the same reason."""

ORDER_S: Final = 120.0
"""How long the agent may take to carry an order out: a large component moves over a slow link."""

ORDERS_SHOWN: Final = 500
"""Orders that the log remembers."""

IDS_REMEMBERED: Final = 1_024
"""Of one user's orders: one that is sent again because its answer was lost is not carried out again."""

USERS_REMEMBERED: Final = 256
"""Users whose orders are remembered."""

SESSION_S: Final = 12 * 3600.0
"""After so long without a request or an open window a session is over: a working day."""

SESSION_MAX_S: Final = 24 * 3600.0
"""After so long it is over in any case."""

GUESSES_AT_ONCE: Final = 8
"""Passwords that wait to be checked, one after the other."""

ASKED_A_S: Final = 10.0
"""Sessions, metrics and risks for one user or address a second, in the long run …"""

ASKED_AT_ONCE: Final = 40
"""… and at once."""

HEALTH_S: Final = 1.0
"""How long an answer about the agent's health is given again: anyone may ask."""

HEAD_S: Final = 10.0
"""How long the head of a request may take."""

CONNECTIONS_OF_ONE_MAX: Final = 64
"""Connections of one user of this robot, or of one address; WebSockets, which are limited for each user, not counted."""

PERIOD_S: Final = 0.2
"""Between two pictures for one user; a client gets at most so many a second: five."""

AWAY_S: Final = 0.5
"""Between two tries to reach an agent that is away."""

STORY_LINES: Final = 200
"""Decisions that the timeline of a component shows, the newest."""

OUTPUT_TAIL: Final = 16 << 10
"""Bytes of each stream that a component's view begins with."""

OUTPUT_HELD: Final = 64 << 10
"""Bytes of output that wait for a client that does not read; more is left out, and the view says so."""

POINTS: Final = 600
"""Of each chart: ten minutes, a point a second."""

CHARTS_MAX: Final = 2_048
"""Charts that are remembered at once."""
