"""What the worker asks the directory process, and what it answers."""

from __future__ import annotations

from msgspec import Struct


class Question(Struct, frozen=True, tag=True):
    """Who is this user, for this verb?

    Attributes:
        password: as typed; None where the robot's kernel vouches for the user.
        origin: who tries the password: failures of one origin do not slow another one down.
    """

    user: str
    verb: str
    password: str | None = None
    origin: str = ""


class Answer(Struct, frozen=True, tag=True):
    """What the directory knows of the user.

    Attributes:
        refusal: why the user is not known to be one; "" where ``groups`` hold.
        copy: what to say of the age of a copy.
        away: why the server does not answer; "" where it does.
        age_s: seconds since the server said so.
        is_stranger: the server says that it has no such user.
    """

    groups: tuple[str, ...] = ()
    refusal: str = ""
    copy: str = ""
    is_stranger: bool = False
    away: str = ""
    age_s: float = 0.0


def spelled_age(age_s: float) -> str:
    """A span of seconds as a person says it: 12 s, 5 min, 3 h."""
    if age_s < 120:
        return f"{age_s:.0f} s"
    return f"{age_s / 60:.0f} min" if age_s < 5_400 else f"{age_s / 3_600:.0f} h"
