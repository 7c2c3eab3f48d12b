"""Users of rights by this machine's accounts and groups (NSS), and by ``[rights.groups]``."""

from __future__ import annotations

import grp
import os
import pwd
from collections.abc import Mapping, Sequence

from failover.core.rights.rules import Subject
from failover.errors import RightsError


def subject_named(user: str, groups: Mapping[str, Sequence[str]]) -> Subject:
    """A user by name.

    Args:
        groups: group → its users, besides those of the machine.

    Raises:
        RightsError: neither this machine nor any group has the user.
    """
    try:
        return _subject(pwd.getpwnam(user), groups)
    except (KeyError, ValueError):  # ValueError: it holds what no name of an account can
        found = frozenset(group for group, users in groups.items() if user in users)
        if not found:
            raise RightsError(
                f"this machine has no user {user!r}, and no group of [rights.groups] has one; see getent passwd"
            ) from None
        return Subject(f"user:{user}", found)


def subject_of(uid: int, groups: Mapping[str, Sequence[str]]) -> Subject:
    """A user by number; one without an account has no groups."""
    try:
        return _subject(pwd.getpwuid(uid), groups)
    except KeyError:
        return Subject(f"uid:{uid}", uid=uid)


def account_of(name: str) -> pwd.struct_passwd:
    """The account of a user by name or number.

    Raises:
        KeyError: this machine has none.
    """
    return pwd.getpwuid(int(name)) if name.isdecimal() else pwd.getpwnam(name)


def uid_of(user: str) -> int | None:
    """The account's number; None without an account."""
    try:
        return pwd.getpwnam(user).pw_uid
    except (KeyError, ValueError):
        return None


def name_of(uid: int) -> str:
    """The account's name; "" without an account."""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return ""


def _subject(account: pwd.struct_passwd, groups: Mapping[str, Sequence[str]]) -> Subject:
    found = {group for group, users in groups.items() if account.pw_name in users}
    for gid in os.getgrouplist(account.pw_name, account.pw_gid):
        try:
            found.add(grp.getgrgid(gid).gr_name)
        except KeyError:
            continue
    return Subject(f"uid:{account.pw_uid}", frozenset(found), account.pw_uid, stands_above=account.pw_uid == 0)
