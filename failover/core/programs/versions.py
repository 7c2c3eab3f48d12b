"""Versions of a program, and the rule against a way back that no person ordered."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final

from failover.errors import BundleRefusedError, ProgramError

PARTS_MAX: Final = 4
PART_MAX: Final = 999_999_999

_VERSION: Final = re.compile(rf"(0|[1-9][0-9]{{0,8}})(\.(0|[1-9][0-9]{{0,8}})){{0,{PARTS_MAX - 1}}}", re.ASCII)


def order(version: str) -> tuple[int, ...]:
    """By which versions are compared: ``1.10`` is newer than ``1.9``; ``1`` and ``1.0`` are the same.

    Raises:
        ProgramError: it is no version.
    """
    if not _VERSION.fullmatch(version):
        raise ProgramError(
            f"{version[:40]!r} is no version: write one to {PARTS_MAX} numbers up to {PART_MAX} with dots between them, as 1.4.2"
        )
    parts = [int(part) for part in version.split(".")]
    while parts and not parts[-1]:
        parts.pop()
    return tuple(parts)


def check_no_downgrade(name: str, version: str, digest: str, floor: str, known: Iterable[tuple[str, str]]) -> None:
    """Refuse a bundle that would bring back an older version, or another content under a version that is taken.

    Args:
        floor: the version that last passed its health check here; "" where none has.
        known: (version, digest) of each bundle that is staged here.

    Raises:
        BundleRefusedError: says which version stands against it.
    """
    for other, content in known:
        if content == digest:
            return
        if order(other) == order(version):
            raise BundleRefusedError(
                f"{name} {version} is here already with another content ({content[:12]}, and not {digest[:12]}): "
                "give the new one a higher version"
            )
    if floor and order(version) < order(floor):
        raise BundleRefusedError(
            f"{name} {version} is older than {floor}, which runs here: a downgrade needs a bundle with a higher version, "
            f"or failover program rollback {name}"
        )
