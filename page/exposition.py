"""Metrics in Prometheus' text format. Pure: answers of the agent in, text out.

Each page tells what its own robot knows; Prometheus tells the robots apart by the address that it asks. Spans are in seconds.

Source: Prometheus, "Exposition formats", text format 0.0.4; its naming rules ("Metric and label naming").
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"

_ESCAPED: Final = {"\\": r"\\", "\n": r"\n", '"': r"\""}

Labels = Mapping[str, str]
Sample = tuple[Labels, float | int | bool | None]


class Exposition:
    """Families of samples, in the order in which they are added."""

    def __init__(self) -> None:
        self._lines: list[str] = []

    def add(self, name: str, kind: str, says: str, samples: Iterable[Sample]) -> None:
        """One family; a sample without a value is left out, and so is a family without samples.

        Args:
            name: without ``failover_``. kind: gauge or counter.
        """
        lines = [_line(f"failover_{name}", labels, value) for labels, value in samples if value is not None]
        if lines:
            self._lines += [f"# HELP failover_{name} {says}", f"# TYPE failover_{name} {kind}", *lines]

    def text(self) -> str:
        """The whole answer."""
        return "\n".join([*self._lines, ""])


def _line(name: str, labels: Labels, value: float) -> str:
    told = ",".join(f'{label}="{_escaped(text)}"' for label, text in labels.items())
    return f"{name}{{{told}}} {_number(value)}" if told else f"{name} {_number(value)}"


def _escaped(text: str) -> str:
    return re.sub(r'[\\\n"]', lambda found: _ESCAPED[found[0]], str(text))


def _number(value: float) -> str:
    return str(int(value)) if isinstance(value, bool | int) or value == int(value) else repr(float(value))


def _seconds(value: float | None, unit: float) -> float | None:
    return None if value is None else round(value / unit, 9)


def of_team(found: Exposition, status: Mapping[str, Any]) -> None:
    """The agent, its heartbeats, its links and the other members."""
    ours = {"robot": str(status["robot"]), "team": str(status["team"]), "version": str(status["version"])}
    found.add("agent_info", "gauge", "The agent that answered; always 1.", [(ours, 1)])
    found.add("healthy", "gauge", "1: nothing is degraded, as far as this robot knows.", [({}, status["healthy"])])
    found.add("agent_starts_total", "counter", "Starts of this robot's agent.", [({}, status["life"])])
    memory = status.get("memory") or {}
    rows = [({"of": name}, memory.get(name)) for name in ("agent", "keepers", "remembered")]
    found.add("memory_bytes", "gauge", "Private memory of the agent, its keepers, and of remembered pages.", rows)
    rows = [({"process": name}, count) for name, count in (status.get("descriptors") or {}).items()]
    found.add("open_descriptors", "gauge", "Open descriptors of the agent's processes.", rows)
    beats = status["beats"]
    for name in ("sent", "heard", "unsent"):
        found.add(f"heartbeats_{name}_total", "counter", f"Heartbeats {name} in this life of the agent.", [({}, beats[name])])
    rows = [({"reason": reason}, count) for reason, count in beats["refused"].items()]
    found.add("heartbeats_refused_total", "counter", "Heartbeats that were not believed.", rows)
    found.add("heartbeat_gaps_total", "counter", "Times when this robot's own heartbeats were late.", [({}, beats["gaps"])])
    found.add("heartbeat_gap_max_seconds", "gauge", "The longest of these.", [({}, _seconds(beats["gap_us_max"], 1e6))])
    found.add(
        "loop_late_max_seconds", "gauge", "The most that the main loop was late.", [({}, _seconds(beats["late_us_max"], 1e6))]
    )
    links = [({"link": str(one["name"]), "medium": str(one["medium"])}, one) for one in status["links"]]
    found.add("link_carrier", "gauge", "1: the cable is in.", [(labels, one["carrier"]) for labels, one in links])
    rows = [({**labels, "direction": way}, one[f"bytes_{way}"]) for labels, one in links for way in ("in", "out")]
    found.add("link_bytes_total", "counter", "Bytes that the kernel counted on a link.", rows)
    _of_peers(found, status["peers"])


def _of_peers(found: Exposition, peers: Sequence[Mapping[str, Any]]) -> None:
    rows = [({"peer": str(one["name"]), "role": str(one["role"])}, one) for one in peers]
    found.add("peer_live", "gauge", "1: its heartbeats arrive.", [(labels, one["state"] == "live") for labels, one in rows])
    silent = [(labels, _seconds(one["last_heard_ms"], 1e3)) for labels, one in rows]
    found.add("peer_silent_seconds", "gauge", "Since its last heartbeat.", silent)
    lost = [(labels, one["beats_lost"]) for labels, one in rows]
    found.add("peer_heartbeats_lost_total", "counter", "Its heartbeats that did not arrive.", lost)
    connected = [(labels, one["lane"] == "connected") for labels, one in rows]
    found.add("peer_replication_link", "gauge", "1: snapshots can travel to it.", connected)


OF_COMPONENTS: Final = (
    ("epoch", "epoch", 1.0, "gauge", "The number of its primacy."),
    ("checkpoint_age_seconds", "lag_ms", 1e3, "gauge", "Age of what the standby holds."),
    ("commit_age_seconds", "commit_age_ms", 1e3, "gauge", "Age of the newest commit of a program that keeps its state."),
    ("freeze_seconds", "freeze_us", 1e6, "gauge", "How long the newest snapshot stopped it."),
    ("freeze_max_seconds", "freeze_us_max", 1e6, "gauge", "The longest freeze of this life."),
    ("freeze_budget_missed_total", "freeze_budget_missed", 1.0, "counter", "Snapshots that took longer than freeze_budget_ms."),
    ("snapshot_period_seconds", "period_ms", 1e3, "gauge", "Time between two snapshots now."),
    ("snapshot_bytes", "snapshot_size", 1.0, "gauge", "Bytes of the newest snapshot on the wire."),
    ("snapshots_total", "snapshots", 1.0, "counter", "Snapshots taken here, or come to here."),
    ("restores_total", "restores", 1.0, "counter", "Restores at this robot."),
    ("crashes_total", "crashes", 1.0, "counter", "Ends by a signal at this robot."),
    ("restarts_total", "restarts", 1.0, "counter", "Starts anew after an end."),
    ("outage_seconds", "outage_ms", 1e3, "gauge", "How long the last takeover had it stand still."),
    ("output_waiting_bytes", "output_waiting", 1.0, "gauge", "Output that waits until another robot holds it."),
)


def of_components(found: Exposition, components: Sequence[Mapping[str, Any]]) -> None:
    """Each component, as this robot sees it."""
    rows = [({"component": str(one["name"])}, one) for one in components if one.get("state") not in ("released", "absent")]
    roles = [({**labels, "role": str(one["role"])}, 1) for labels, one in rows]
    found.add("component_role", "gauge", "What this robot is to it; always 1.", roles)
    states = [({**labels, "state": str(one["state"])}, 1) for labels, one in rows]
    found.add("component_state", "gauge", "Its state at this robot; always 1.", states)
    ours = [(labels, one) for labels, one in rows if one["role"] == "primary"]
    protected = [(labels, one["protection"] == "protected") for labels, one in ours]
    found.add("component_protected", "gauge", "1: another robot holds a checkpoint. Told by its primary.", protected)
    for name, field, unit, kind, says in OF_COMPONENTS:
        found.add(f"component_{name}", kind, says, [(labels, _seconds(one.get(field), unit)) for labels, one in rows])
    for name, field, says in (
        ("component_kept_checkpoints", "checkpoints", "Checkpoints in this robot's store."),
        ("component_kept_bytes", "size", "Bytes of these."),
    ):
        found.add(name, "gauge", says, [(labels, (one.get("kept") or {}).get(field)) for labels, one in rows])


def of_board(found: Exposition, items: Sequence[Mapping[str, Any]]) -> None:
    """Items of the board at this robot."""
    rows = [({"of": str(one["robot"]), "item": str(one["item"])}, one) for one in items]
    for name, field, says in (
        ("age_seconds", "age_ms", "Since it was put, at least."),
        ("age_max_seconds", "age_max_ms", "The same, at most."),
        ("bound_seconds", "bound_ms", "Past it a value is stale."),
    ):
        found.add(f"board_item_{name}", "gauge", says, [(labels, _seconds(one.get(field), 1e3)) for labels, one in rows])
    found.add("board_item_stale", "gauge", "1: older than its bound.", [(labels, one["stale"]) for labels, one in rows])
    found.add("board_item_puts_total", "counter", "Puts.", [(labels, one["put"]) for labels, one in rows])
    found.add(
        "board_item_frames_lost_total", "counter", "Frames with it that did not arrive.", [(x, one["lost"]) for x, one in rows]
    )


def of_tasks(found: Exposition, tasks: Sequence[Mapping[str, Any]]) -> None:
    """Tasks of this robot's schedule."""
    rows = [({"task": str(one["task"])}, one) for one in tasks]
    for name, field, says in (
        ("activations_total", "started", "Activations begun."),
        ("misses_total", "misses", "Deadlines missed."),
        ("overruns_total", "overruns", "Activations that lasted into the next one."),
        ("skipped_total", "skipped", "Activations left out."),
    ):
        found.add(f"task_{name}", "counter", says, [(labels, one[field]) for labels, one in rows])
    for name, prefix, says in (
        ("lateness_seconds", "late", "Bound of the lateness of this part of its activations."),
        ("duration_seconds", "took", "Bound of the duration of this part of its activations."),
    ):
        bounds = [
            ({**labels, "part": part}, _seconds(one[f"{prefix}_{key}_ns"] or None, 1e9))
            for labels, one in rows
            for part, key in (("0.5", "p50"), ("0.99", "p99"))
        ]
        found.add(f"task_{name}", "gauge", says, bounds)


def of_page(found: Exposition, sessions: int, orders: Mapping[str, int]) -> None:
    """This page itself.

    Args:
        orders: how they ended → how many.
    """
    found.add("page_sessions", "gauge", "Sessions of this page.", [({}, sessions)])
    found.add("page_orders_total", "counter", "Orders given on this page.", [({"ended": how}, n) for how, n in orders.items()])
