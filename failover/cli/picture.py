"""The team as rows of a tree: what ``failover status`` shows, without saying how it is drawn.

Pure: the agent's answer in (see `failover.client.control.STATUS`), rows of text out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

Mood = Literal["good", "warning", "bad", "quiet"]

COLUMNS: Final = ("", "role", "state", "epoch", "lag", "freeze", "standby", "links")

BAD_STATES: Final = frozenset({"degraded", "failed"})
UNSETTLED_STATES: Final = frozenset({"starting", "restoring", "held", "frozen"})


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the tree; ``cells`` are in the order of `COLUMNS`."""

    cells: tuple[str, ...]
    mood: Mood


def milliseconds(value: float | None) -> str:
    """98 ms, 4.2 s, 7 min; "–" when it is not known."""
    if value is None:
        return "–"
    if value < 1000:
        return f"{value:.0f} ms"
    return f"{value / 1000:.1f} s" if value < 120_000 else f"{value / 60_000:.0f} min"


def microseconds(value: float | None) -> str:
    """A freeze time: always in milliseconds, to a hundredth."""
    return "–" if value is None else f"{value / 1000:.2f} ms"


def size(value: float | None) -> str:
    """12 B, 3.4 KB, 105.0 MB (powers of ten)."""
    if value is None:
        return "–"
    for unit in ("B", "KB", "MB"):
        if value < 1000:
            return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1000
    return f"{value:.1f} GB"


def rows(status: Mapping[str, Any]) -> tuple[Row, ...]:
    """The team's tree, from one agent's answer: robots, below each the components that it is primary of."""
    robots = [(status["robot"], None), *((peer["name"], peer) for peer in status["peers"])]
    components = list(status["components"])
    found: list[Row] = []
    for name, peer in sorted(robots, key=lambda robot: robot[1] is not None):
        found.append(_robot_row(status, name, peer))
        own = [component for component in components if component.get("primary") == name]
        found += _branch(own, "")
    orphans = [component for component in components if component.get("primary") not in {name for name, _ in robots}]
    if orphans:
        found.append(Row(("nobody", *[""] * 7), "bad"))
        found += _branch(orphans, "")
    return tuple(found)


def _robot_row(status: Mapping[str, Any], name: str, peer: Mapping[str, Any] | None) -> Row:
    if peer is None:
        return Row((f"{name} (here)", str(status.get("role") or ""), "live", "", "", "", "", _lanes(status["peers"])), "good")
    state = peer["state"]
    links = ", ".join(part for part in (peer.get("lane") or "", _round_trip(peer)) if part)
    mood: Mood = "good" if state == "live" else "bad" if state == "dead" else "warning"
    return Row((name, "", state, "", "", "", "", links), mood)


def _round_trip(peer: Mapping[str, Any]) -> str:
    value = peer.get("rtt_us")
    return "" if value is None else f"{value / 1000:.1f} ms"


def _lanes(peers: Sequence[Mapping[str, Any]]) -> str:
    connected = sum(peer.get("lane") == "connected" for peer in peers)
    return f"{connected} of {len(peers)} connected" if peers else "no peers"


def _branch(components: Sequence[Mapping[str, Any]], indent: str) -> list[Row]:
    ordered = sorted(components, key=lambda component: str(component["name"]))
    return [_component_row(component, f"{indent}{'└─' if component is ordered[-1] else '├─'} ") for component in ordered]


def _component_row(component: Mapping[str, Any], branch: str) -> Row:
    freeze = microseconds(component.get("freeze_us"))
    worst = component.get("freeze_us_max")
    if worst:
        freeze += f" (max {worst / 1000:.2f})"
    cells = (
        branch + str(component["name"]),
        str(component.get("role") or ""),
        _state(component),
        str(component.get("epoch") or ""),
        milliseconds(component.get("lag_ms")),
        freeze,
        str(component.get("standby") or "none"),
        "",
    )
    return Row(cells, mood_of(component))


def _state(component: Mapping[str, Any]) -> str:
    status = component.get("exit_status")
    if component.get("state") == "ended" and status is not None:
        return f"ended ({ending(status)})"
    return str(component.get("state") or "")


def ending(wait_status: int) -> str:
    """A wait status in words: exit 0, signal 9."""
    number = wait_status & 0x7F
    return f"signal {number}" if number else f"exit {(wait_status >> 8) & 0xFF}"


def mood_of(component: Mapping[str, Any]) -> Mood:
    """How one component is doing."""
    state = component.get("state")
    if state in BAD_STATES:
        return "bad"
    if state == "ended":
        return "quiet"
    return "warning" if state in UNSETTLED_STATES or not component.get("standby") else "good"


def remarks(status: Mapping[str, Any]) -> tuple[str, ...]:
    """What stands below the tree: reasons and notes, each a sentence."""
    found = [f"{component['name']}: {line}" for component in status["components"] for line in component.get("reasons") or ()]
    found += [f"{component['name']}: {line}" for component in status["components"] for line in component.get("notes") or ()]
    found += [f"{peer['name']}: {line}" for peer in status["peers"] for line in peer.get("notes") or ()]
    if status.get("insecure"):
        found.append("links are neither authenticated nor encrypted (insecure = true)")
    return tuple(found) + tuple(status.get("notes") or ())


def is_healthy(status: Mapping[str, Any]) -> bool:
    """Whether everything that should be protected is: no component degraded, failed or without standby, no peer dead."""
    living = [component for component in status["components"] if component.get("state") != "ended"]
    unwell = any(component.get("state") in BAD_STATES or not component.get("standby") for component in living)
    return not unwell and all(peer["state"] != "dead" for peer in status["peers"])
