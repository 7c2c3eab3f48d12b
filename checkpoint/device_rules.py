"""The operator's rules for the devices that a component has open."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable
from typing import Final, Literal

from msgspec import Struct

from checkpoint.model import Resource
from checkpoint.sentences import near

RULES_MAX: Final = 256
"""Rules of one component at most: we look at each rule for each device that it has open."""
RULES: Final = ("reopen", "hook", "optional")
"""As an operator says them."""
KIND: Final = "attached_devices"
"""The kind of resources that are kept by these rules."""


class DeviceRule(Struct, frozen=True):
    """One device.

    Attributes:
        path: as the operator names it, on every robot; a name that stays, such as one of /dev/serial/by-id, is best.
        action: reopen: it is opened again; hook: the program finds its descriptor hung up, as after unplugging, and opens it
            anew.
        there: the path that this robot opens in its place; "" for ``path``.
        optional: where it is missing the program finds it hung up; otherwise it does not run there.
    """

    path: str
    action: Literal["reopen", "hook"] = "reopen"
    there: str = ""
    optional: bool = False

    @property
    def place(self) -> str:
        """The path that this robot opens."""
        return self.there or self.path

    def leads_to(self, target: str) -> bool:
        """Whether it speaks of the device at a path; its own may be links to it."""
        return any(target in (name, os.path.realpath(name)) for name in (self.path, self.there) if name)


def rule_of(held: Resource) -> DeviceRule:
    """The rule by which a device of a snapshot was kept, without its place on the robot where that was."""
    action: Literal["reopen", "hook"] = "hook" if held.facts["action"] == "hook" else "reopen"
    return DeviceRule(str(held.facts["path"]), action, optional=bool(held.facts["optional"]))


def rules_of(resources: Iterable[Resource]) -> tuple[DeviceRule, ...]:
    """The rules of all devices of a snapshot."""
    return tuple(rule_of(held) for held in resources if held.kind == KIND)


def rule_from(path: str, said: str) -> DeviceRule:
    """A rule as it is typed: ``reopen``, ``hook``, ``optional``, or the path that is opened in its place.

    Raises:
        ValueError: it is none, or names no file.
    """
    if said.startswith("/"):
        return checked(DeviceRule(path, there=said))
    if said not in RULES:
        meant = near(said, RULES)
        raise ValueError(f"the rule for {path} is {said!r}; say {', '.join(RULES)}, or the path of a device{meant}")
    return checked(DeviceRule(path, "hook" if said == "hook" else "reopen", optional=said == "optional"))


def travelling(rules: Iterable[DeviceRule]) -> tuple[tuple[str, str], ...]:
    """The rules of one robot as they travel with a component: without paths that exist on that robot alone."""
    return tuple((rule.path, "hook" if rule.action == "hook" else "optional" if rule.optional else "reopen") for rule in rules)


def arrived(said: Iterable[tuple[str, str]]) -> tuple[DeviceRule, ...]:
    """The rules that came with a component. A malformed rule counts as none: the device is refused by name then."""
    found = []
    for path, words in said:
        with contextlib.suppress(ValueError):
            found.append(rule_from(path, words))
    return tuple(found)


def checked(rule: DeviceRule) -> DeviceRule:
    """The rule itself.

    Raises:
        ValueError: a path of it is not absolute.
    """
    for path in (rule.path, rule.place):
        if not path.startswith("/") or "\0" in path:
            raise ValueError(f"{path!r} is not the absolute path of a device")
    return rule


def merged(others: Iterable[DeviceRule], own: Iterable[DeviceRule]) -> tuple[DeviceRule, ...]:
    """The rules that came along with a component, and a robot's own for it, which come in their place."""
    return tuple({rule.path: rule for rule in (*others, *own)}.values())


def rule_for(target: str, rules: Iterable[DeviceRule]) -> DeviceRule | None:
    """The rule of the device at a path; None where there is none."""
    return next((rule for rule in rules if rule.leads_to(target)), None)


def missing(rules: Iterable[DeviceRule]) -> tuple[str, ...]:
    """Which devices this machine lacks, and what would come of it, one sentence each."""
    return tuple(_lack(rule) for rule in rules if rule.action == "reopen" and not os.path.exists(rule.place))


def _lack(rule: DeviceRule) -> str:
    return f"lacks {rule.place}: " + ("it would be found hung up" if rule.optional else "the program could not resume here")
