"""How frames leave over each link, and the ring of slots of each radio, as rows of the page's table. Pure.

``medium:LINK`` is a link; ``member:LINK/ROBOT`` is what this robot sees of a member there. A ring begins at the reference.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

Rows = dict[str, dict[str, Any]]

OF_A_MEDIUM: Final = ("cast", "because", "by_unicast", "period_ms", "no_slots")
OF_SLOTS: Final = ("own", "why", "round", "count", "members", "reference", "followed", "outside", "ignored", "deaf")
OF_A_PEER: Final = ("seen", "missed", "lost", "awaited", "hears")

SPANS: Final = ("round_us", "least_gap_us", "late_us", "late_us_max")

US_PER_MS: Final = 1_000
US_SHOWN: Final = 10
"""Figures change with each look; smaller changes are not told."""

SPEAKING: Final = ("insert", "run")


def of_media(media: Sequence[Mapping[str, Any]], robot: str) -> Rows:
    """All links of this robot.

    Args:
        media: of its status.
        robot: its name.
    """
    found: Rows = {}
    for name, medium in zip(_names(media), media, strict=True):
        slots = medium["slots"]
        row = {field: medium[field] for field in OF_A_MEDIUM} | {"link": name, "own": ""}
        if slots is not None:
            row |= {field: slots[field] for field in OF_SLOTS} | _spans(slots, *SPANS)
        found[f"medium:{name}"] = row
        for member, fields in _members(medium, robot).items():
            found[f"member:{name}/{member}"] = fields | {"medium": name, "robot": member, "here": member == robot}
    return found


def _names(media: Iterable[Mapping[str, Any]]) -> list[str]:
    """Each link by its interface; two of one interface, and one without any, by their place, too."""
    media = list(media)
    times = Counter(str(medium["link"]) for medium in media)
    return [
        name if (name := str(medium["link"])) and times[name] == 1 else f"{name or 'link'} ({place})"
        for place, medium in enumerate(media, 1)
    ]


def _members(medium: Mapping[str, Any], robot: str) -> Rows:
    slots, sizes = medium["slots"], medium["bytes"]
    found: Rows = {str(name): {"bytes": size, "place": None} for name, size in sizes.items()}
    if slots is None:
        return found
    for peer in slots["peers"]:
        if peer["seen"] != "not" or peer["robot"] in found or peer["robot"] in slots["members"]:
            fields = {field: peer[field] for field in OF_A_PEER} | _spans(peer, "offset_us", "jitter_us", "transit_us")
            found[peer["robot"]] = found.get(peer["robot"], {"bytes": 0}) | fields
    heard = [str(peer["robot"]) for peer in slots["peers"] if peer["seen"] in SPEAKING]
    ours = {"seen": "run" if slots["own"] == "running" else "not", "missed": 0, "lost": 0, "awaited": 0, "hears": heard}
    found[robot] = found.get(robot, {"bytes": 0}) | ours | _spans(slots, "offset_us", "jitter_us")
    for name, fields in found.items():
        fields |= _place(slots, name, medium["period_ms"])
    return found


def _place(slots: Mapping[str, Any], name: str, period_ms: float) -> dict[str, Any]:
    """Where its slot begins, counted from the reference's."""
    members = list(slots["members"])
    if name not in members:
        return {"place": None, "planned_ms": None}
    first = members.index(slots["reference"]) if slots["reference"] in members else 0
    place = (members.index(name) - first) % len(members)
    return {"place": place, "planned_ms": round(place * period_ms / len(members), 2)}


def _spans(told: Mapping[str, Any], *fields: str) -> dict[str, float]:
    """The same in milliseconds."""
    return {field.replace("_us", "_ms"): round(told[field] / US_SHOWN) * US_SHOWN / US_PER_MS for field in fields}
