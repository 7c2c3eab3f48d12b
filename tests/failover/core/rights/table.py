"""Four users, eight verbs, six paths: what the example's rules allow. Asked of the pure rule, and of a real directory server."""

from __future__ import annotations

from typing import Final

from failover.core.rights import hours
from failover.core.rights.rules import VERBS, Rule, make_rule

RULES: Final[tuple[Rule, ...]] = (
    make_rule(
        ["drivers"],
        ["see", "read", "call"],
        ["University/Lab/**"],
        hours=hours.parse("Mon-Fri 08:00-20:00"),
        place="rights.toml:4",
    ),
    make_rule(["operators"], ["*", "!grant"], ["**"], place="rights.toml:9"),
    make_rule(["students"], ["see", "call", "program"], ["University/**"], place="rights.toml:13"),
    make_rule(["students"], ["program", "put"], ["**/Engines/**"], deny=True, place="rights.toml:17"),
    make_rule(["owners"], ["grant"], ["University/*"], place="rights.toml:22"),
)

GROUPS: Final = {
    "driver": frozenset({"drivers"}),
    "operator": frozenset({"operators"}),
    "student": frozenset({"students", "owners"}),
    "stranger": frozenset({"guests"}),
}

PATHS: Final = (
    "University",
    "University/Lab",
    "University/Lab/Robotino/Engines/3/PWM",
    "/University/Lab/robot1/mapper",
    "University/Hall",
    "Home/Robotino/Engines/1/PWM",
)

MONDAY_NOON: Final = hours.minute_of(0, 12, 0)
SUNDAY_NOON: Final = hours.minute_of(6, 12, 0)

LETTERS: Final = dict(zip("srcpoagt", ("see", "read", "call", "put", "operate", "start", "program", "grant"), strict=True))
"""Letter of the table → verb; ``p`` is put, ``a`` start, ``g`` program, ``t`` grant."""

ALLOWED: Final = {
    # University  University/Lab  …/PWM   …/mapper  University/Hall  Home/…
    "driver": ("", "src", "src", "src", "", ""),
    "operator": ("srcpoag",) * 6,
    "student": ("scg", "scgt", "sc", "scg", "scgt", ""),
    "stranger": ("",) * 6,
}
"""User → for each path the letters of the verbs that are allowed on Monday at noon; all others are denied."""


def expected(user: str, verb: str, path: str) -> bool:
    """What the table says."""
    return verb in [LETTERS[letter] for letter in ALLOWED[user][PATHS.index(path)]]


CASES: Final = [(user, verb, path) for user in GROUPS for verb in VERBS for path in PATHS]
