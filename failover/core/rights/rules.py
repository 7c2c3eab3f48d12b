"""The rule of rights: groups × verbs × paths → allow or deny, and the sentence why.

The first rule that denies wins, else any rule that allows, else the answer is deny. Without a file of rules `without_rules` tells
a person what `agent.system.permissions` decides.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

from msgspec import Struct

from checkpoint.sentences import near
from failover.core.rights import paths
from failover.core.rights.hours import Hours, spelled
from failover.errors import RightsError

VERBS: Final = {
    "see": "the tree: names, values of the status, the event log",
    "read": "the output of programs, and the board",
    "call": "commands of drivers",
    "put": "the board",
    "operate": "handover, failback, prefer, promote, release, stop; changes of tasks",
    "start": "run and protect programs",
    "program": "send a program, switch it, roll it back",
    "grant": "see and change the rights of others, and keys",
}
"""Verb → what it covers."""

NEVER_BY_DEFAULT: Final = ("program", "grant")
"""Only a rule gives these, also to root: they decide which code runs, and who decides."""

ALL: Final = "@all"
"""The group of every user whose name is vouched for."""

OWNER: Final = "@owner"
"""The group of the one user who started what the path names."""

ROBOTS: Final = "@robots"
"""The group of the team's robots, where one of them asks for itself."""

RELATIONS: Final = (ALL, OWNER, ROBOTS)
RULES_MAX: Final = 1_000
"""Each is looked at for each question."""


class Subject(Struct, frozen=True):
    """Who asks.

    Attributes:
        name: with the source that vouches for it: ``uid:1000``, ``ldap:user1``, ``robot:robot2``.
        groups: as that source tells them. None of them can stand for a relation (``@…``) or for a subject's name.
        uid: of the user on the robot; None where there is none.
        is_owner: the path names what this user started.
        stands_above: root and the agent's own user on the robot itself, who could change the file of rules.
        copy: "" for groups that were asked for now; else what to say of the copy that they are from.
    """

    name: str
    groups: frozenset[str] = frozenset()
    uid: int | None = None
    is_owner: bool = False
    stands_above: bool = False
    copy: str = ""


class Rule(Struct, frozen=True):
    """One rule, as a file has it.

    Attributes:
        groups: groups, relations (``@all``, ``@owner``, ``@robots``) and names of subjects (``uid:1000``).
        verbs: those that it is about.
        patterns: as written → its steps, see `failover.core.rights.paths.pattern_of`.
        place: "file:line" where it stands.
    """

    groups: tuple[str, ...]
    verbs: frozenset[str]
    patterns: dict[str, tuple[str, ...]]
    deny: bool = False
    hours: Hours | None = None
    place: str = ""

    def group_of(self, subject: Subject) -> str:
        """The first of its groups to which a subject belongs; "" for none."""
        return next((group for group in self.groups if _belongs(subject, group)), "")

    def pattern_for(self, steps: tuple[str, ...]) -> str:
        """The first of its patterns that fits a path; "" for none."""
        return next((text for text, pattern in self.patterns.items() if paths.fits(pattern, steps)), "")


class Decision(Struct, frozen=True):
    """An answer. ``rule``: the one that decided; None where none did."""

    allow: bool
    because: str
    rule: Rule | None = None

    def __bool__(self) -> bool:
        return self.allow


def make_rule(
    groups: Sequence[str],
    verbs: Iterable[str],
    patterns: Sequence[str],
    *,
    deny: bool = False,
    hours: Hours | None = None,
    place: str = "",
) -> Rule:
    """A rule whose words are checked; ``verbs`` may hold ``*`` for all, and ``!grant`` for all but that.

    Raises:
        RightsError: names the key that is wrong.
    """
    if not groups:
        raise RightsError('groups is empty, so that the rule would be about no user; write groups = ["@all"] for all', "groups")
    for group in groups:
        if not group or not group.isprintable():
            raise RightsError(f"{group!r} is no group", "groups")
        if group.startswith("@") and group not in RELATIONS:
            raise RightsError(f"{group!r} is none of {', '.join(RELATIONS)}{near(group, RELATIONS)}", "groups")
    if not patterns:
        raise RightsError('paths is empty, so that the rule would be about nothing; write paths = ["**"] for all', "paths")
    try:
        found = {text: paths.pattern_of(text) for text in patterns}
    except RightsError as error:
        raise RightsError(str(error), "paths") from error
    return Rule(tuple(groups), _verbs(tuple(verbs)), found, deny, hours, place)


def decide(rules: Iterable[Rule], subject: Subject, verb: str, path: str, minute: int) -> Decision:
    """May this subject do this to that path, at this minute of the week?

    Raises:
        RightsError: there is no such verb, or it is no path.
    """
    check_verb(verb)
    steps = paths.steps_of(path)
    what = f"{subject.name} may {verb} {path}"
    not_now: list[Rule] = []
    allowing: Rule | None = None
    for rule in rules:
        if verb not in rule.verbs or not rule.group_of(subject) or not rule.pattern_for(steps):
            continue
        if rule.hours is not None and not rule.hours.hold(minute):
            not_now.append(rule)
        elif rule.deny and not _is_above(subject, verb):
            return Decision(False, _negated(subject, verb, path) + _by(rule, subject, steps), rule)
        elif not rule.deny:
            allowing = allowing or rule
    if allowing is not None:
        return Decision(True, what + _by(allowing, subject, steps), allowing)
    if _is_above(subject, verb):
        return Decision(True, f"{what}: root and the agent's user on the robot itself stand above the rules")
    return Decision(False, _negated(subject, verb, path) + _no_rule(subject, not_now, minute))


def without_rules(subject: Subject, verb: str, path: str) -> Decision:
    """The same where there is no file of rules: root, the agent's user and the owner may; everyone who may connect may see.

    Raises:
        RightsError: there is no such verb, or it is no path.
    """
    check_verb(verb)
    paths.steps_of(path)
    what, not_what = f"{subject.name} may {verb} {path}", _negated(subject, verb, path)
    if verb in NEVER_BY_DEFAULT:
        return Decision(False, f"{not_what}: there are no rules, and only a rule gives {verb}")
    if subject.stands_above:
        return Decision(True, f"{what}: there are no rules, so root and the agent's user may")
    if verb == "see":
        return Decision(True, f"{what}: there are no rules, so a user who may connect may see")
    if verb == "start":
        return Decision(True, f"{what}: there are no rules, so a user who may connect runs programs as itself")
    if subject.is_owner:
        return Decision(True, f"{what}: there are no rules, so its owner may")
    return Decision(False, f"{not_what}: there are no rules, so only its owner, root and the agent's user may")


def check_verb(verb: str) -> None:
    """Raises RightsError: there is no such verb."""
    if verb not in VERBS:
        raise RightsError(f"{verb!r} is none of {', '.join(VERBS)}{near(verb, tuple(VERBS))}", "verbs")


def _belongs(subject: Subject, group: str) -> bool:
    if group == ALL:
        return not subject.name.startswith("robot:")
    if group == OWNER:
        return subject.is_owner
    if group == ROBOTS:
        return subject.name.startswith("robot:")
    return subject.name == group if ":" in group else group in subject.groups


def _is_above(subject: Subject, verb: str) -> bool:
    return subject.stands_above and verb not in NEVER_BY_DEFAULT


def _verbs(said: tuple[str, ...]) -> frozenset[str]:
    found: set[str] = set()
    for word in said:
        if word != "*":
            check_verb(word.removeprefix("!"))
    for word in said:
        if not word.startswith("!"):
            found |= set(VERBS) if word == "*" else {word}
    found -= {word.removeprefix("!") for word in said if word.startswith("!")}
    if not found:
        raise RightsError('verbs leaves none: write verbs = ["*", "!grant"] for all but grant', "verbs")
    return frozenset(found)


def _by(rule: Rule, subject: Subject, steps: tuple[str, ...]) -> str:
    word = "denies" if rule.deny else "allows"
    during = f" during {rule.hours.text}" if rule.hours is not None else ""
    told = f": {rule.place or 'a rule'} {word} it to {rule.group_of(subject)} on {rule.pattern_for(steps)}{during}"
    return told + _copied(subject)


def _no_rule(subject: Subject, not_now: list[Rule], minute: int) -> str:
    outside = [rule for rule in not_now if not rule.deny]
    if outside:
        rule = outside[0]
        hours = rule.hours.text if rule.hours is not None else ""
        return f": {rule.place or 'a rule'} allows it during {hours} only, and it is {spelled(minute)}" + _copied(subject)
    groups = ", ".join(sorted(subject.groups)[:8]) or "no group"
    return f": no rule allows it to {groups}" + _copied(subject)


def _copied(subject: Subject) -> str:
    return f"; {subject.copy}" if subject.copy else ""


def _negated(subject: Subject, verb: str, path: str) -> str:
    return f"{subject.name} may not {verb} {path}"
