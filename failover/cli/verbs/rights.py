"""rights list, rights why: the rules, and what they say to one question; the agent tells groups that a directory server knows."""

from __future__ import annotations

import argparse
from datetime import datetime
from pathlib import Path
from typing import Any

from failover.cli.connection import connect
from failover.cli.output import render
from failover.config import accounts
from failover.config import rights as rights_file
from failover.config.rights import Rights
from failover.core.rights import hours
from failover.core.rights.rules import Decision, Rule, Subject, decide, without_rules
from failover.errors import NoAgentError


def show(arguments: argparse.Namespace) -> int:
    """List the rules in the order of the file."""
    found = rights_file.read(Path(arguments.directory))
    rules = [_told(rule) for rule in found.rules] if found is not None else []
    if arguments.json:
        render.as_json({"source": found.config.source if found is not None else "", "rules": rules})
        return 0
    if found is None:
        place = Path(arguments.directory) / rights_file.RIGHTS_FILE
        print(
            f"{place}: there is no such file, so these rights hold: root and the agent's user may do all but program and grant;"
        )
        print(
            "a user who may connect sees the team and starts programs as itself; the owner of a component may do the same with it"
        )
        return 0
    for rule in rules:
        word, during = "deny " if rule["deny"] else "allow", f"  {rule['hours']}" if rule["hours"] else ""
        words = [", ".join(rule[key]) for key in ("groups", "verbs", "paths")]
        print(f"{rule['place']}  {word}  {'  |  '.join(words)}{during}")
    print("all else is denied")
    return 0


def why(arguments: argparse.Namespace) -> int:
    """One question, the answer and its reason. Exit status 1: it is denied."""
    found = rights_file.read(Path(arguments.directory))
    if found is not None and found.config.source == "ldap" and arguments.groups is None:
        told = _asked(arguments)
    else:
        subject = _subject(arguments.user, found, arguments.groups)
        answer = _answer(found, subject, arguments)
        told = {"allow": answer.allow, "because": answer.because, "groups": sorted(subject.groups)}
        told |= {"place": answer.rule.place if answer.rule is not None else ""}
    if arguments.json:
        render.as_json(told)
    else:
        print(told["because"])
    return 0 if told["allow"] else 1


def _asked(arguments: argparse.Namespace) -> dict[str, Any]:
    """The agent's answer, which knows the directory server.

    Raises:
        NoAgentError: there is none; says what to do without.
    """
    try:
        with connect(arguments) as agent:
            return agent.ask("rights", user=arguments.user, right=arguments.right, path=arguments.path)
    except NoAgentError as error:
        sentence = f"the agent asks the directory server for the groups of {arguments.user}, and {error}"
        raise NoAgentError(f"{sentence}; without an agent name groups to try: --groups a,b") from error


def _answer(found: Rights | None, subject: Subject, arguments: argparse.Namespace) -> Decision:
    if found is None:
        return without_rules(subject, arguments.right, arguments.path)
    now = datetime.now()
    return decide(found.rules, subject, arguments.right, arguments.path, hours.minute_of(now.weekday(), now.hour, now.minute))


def _subject(user: str, found: Rights | None, groups: str | None) -> Subject:
    """The user as this machine knows it, or with the groups that were given."""
    of_ldap = found is not None and found.config.source == "ldap"
    if groups is not None:
        return Subject(f"{'ldap' if of_ldap else 'user'}:{user}", frozenset(filter(None, groups.split(","))))
    return accounts.subject_named(user, found.config.groups if found is not None else {})


def _told(rule: Rule) -> dict[str, Any]:
    told = {"place": rule.place, "deny": rule.deny, "groups": list(rule.groups), "verbs": sorted(rule.verbs)}
    return told | {"paths": list(rule.patterns), "hours": rule.hours.text if rule.hours is not None else ""}
