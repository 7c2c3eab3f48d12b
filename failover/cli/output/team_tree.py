"""The team as rows of a tree, as ``failover status`` shows it, independent of how it is drawn.

Pure: the agent's answer in (see `failover.client.control.STATUS`), rows of text out.
"""

from __future__ import annotations

import re
import time
from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal

from msgspec import Struct

from failover.client.health import BAD_STATES as BAD_STATES
from failover.client.health import OVER_STATES, is_lacking, is_unknown, is_unprotected, is_unwell, sight
from failover.client.health import is_healthy as is_healthy
from failover.errors import AgentRefusedError

Mood = Literal["good", "warning", "bad", "quiet"]

COLUMNS: Final = ("", "role", "state", "engine", "epoch", "lag", "freeze", "standby", "links")

UNSETTLED_STATES: Final = frozenset({"starting", "restarting", "restoring", "held", "frozen"})


class Row(Struct, frozen=True):
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


def ago(value: float | None) -> str:
    """14 s ago."""
    return f"{milliseconds(round(value, -3) if value and value >= 10_000 else value).replace('.0 s', ' s')} ago"


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
    components = [seen for seen in map(sight, status["components"]) if seen.get("state") != "released"]
    found: list[Row] = []
    for name, peer in sorted(robots, key=lambda robot: robot[1] is not None):
        found.append(_robot_row(status, name, peer))
        own = [component for component in components if component.get("primary") == name]
        found += _branch(own, "")
    orphans = [component for component in components if component.get("primary") not in {name for name, _ in robots}]
    if orphans:
        found.append(Row(("no robot", *[""] * (len(COLUMNS) - 1)), "bad"))
        found += _branch(orphans, "")
    found += [_far_row(one) for one in status.get("far") or ()]
    return tuple(found)


def _far_row(one: Mapping[str, Any]) -> Row:
    """A member of another site: it counts neither as live nor as dead here."""
    heard = one.get("items_heard_ms")
    items = f", items heard {milliseconds(heard)} ago" if heard is not None else ""
    state = f"at {one.get('site') or 'the site without a name'}"
    mood: Mood = "good" if one.get("lane") == "connected" else "warning"
    return Row((str(one["name"]), str(one.get("role") or ""), state, "", "", "", "", "", f"{one.get('lane')}{items}"), mood)


def _robot_row(status: Mapping[str, Any], name: str, peer: Mapping[str, Any] | None) -> Row:
    mood: Mood
    if peer is None:
        state, mood = ("live, drained", "warning") if status.get("drained") else ("live", "good")
        return Row((f"{name} (here)", str(status.get("role") or ""), state, "", "", "", "", "", _connections(status)), mood)
    state, mood = peer["state"], mood_of_robot(peer["state"])
    if peer.get("drained"):
        state, mood = f"{state}, drained", "warning" if mood == "good" else mood
    return Row((name, str(peer.get("role") or ""), state, "", "", "", "", "", links_of(peer)), mood)


def links_of(peer: Mapping[str, Any]) -> str:
    """How the replication link to a peer is, and how many of its heartbeats were lost."""
    lost = peer.get("beats_lost")
    return ", ".join(part for part in (peer.get("lane") or "", f"{lost} beat{'s' * (lost > 1)} lost" if lost else "") if part)


def mood_of_robot(state: str) -> Mood:
    """How a robot is doing."""
    return "good" if state == "live" else "bad" if state == "dead" else "warning"


def _connections(status: Mapping[str, Any]) -> str:
    peers = status["peers"]
    connected = sum(peer.get("lane") == "connected" for peer in peers)
    refused = sum((status.get("beats") or {}).get("refused", {}).values())
    connections = f"{connected} of {len(peers)} connected" if peers else "no peers"
    return connections + (f", {refused} beats refused" if refused else "")


def _branch(components: Sequence[Mapping[str, Any]], indent: str) -> list[Row]:
    ordered = sorted(components, key=lambda component: str(component["name"]))
    return [_component_row(component, f"{indent}{'└─' if component is ordered[-1] else '├─'} ") for component in ordered]


def _component_row(component: Mapping[str, Any], branch: str) -> Row:
    is_frozen = component.get("engine") != "cooperative"
    freeze = microseconds(component.get("freeze_us")) if is_frozen else "never"
    worst = component.get("freeze_us_max")
    if worst and is_frozen:
        freeze += f" (max {worst / 1000:.2f})"
    cells = (
        branch + str(component["name"]),
        str(component.get("role") or ""),
        state_of(component),
        str(component.get("engine") or ""),
        str(component.get("epoch") or ""),
        milliseconds(component.get("lag_ms")),
        freeze,
        standby_of(component),
        "",
    )
    return Row(cells, mood_of(component))


def standby_of(component: Mapping[str, Any]) -> str:
    """The robot that would resume it; whether its program waits there already, where one can."""
    standby, warm = component.get("standby"), component.get("warm")
    if not standby or warm is None:
        return f"{standby or 'none'}{', ready' if component.get('ready') else ''}"
    return f"{standby}, {'warm' if warm else 'cold'}"


def state_of(component: Mapping[str, Any]) -> str:
    """Its state in words, with how it ended."""
    status = component.get("exit_status")
    if component.get("state") in ("ended", "failed") and status is not None:
        return f"{component['state']} ({ending(status)})"
    if component.get("state") == "running" and is_unprotected(component):
        return "running, unprotected"
    if component.get("state") == "running" and component.get("commit_overdue"):
        return f"running, last commit {ago(component.get('commit_age_ms'))}"
    return str(component.get("state") or "")


def named(status: Mapping[str, Any], wanted: str) -> Mapping[str, Any]:
    """The component that a person means: its whole name, or an end of it that fits one alone.

    Raises:
        AgentRefusedError: none, or more than one.
    """
    known: list[Mapping[str, Any]] = [one for one in status["components"] if sight(one).get("state") != "released"]
    fitting = [one for one in known if one["name"] == wanted]
    fitting = fitting or [one for one in known if one["name"].endswith("/" + wanted.lstrip("/"))]
    if len(fitting) == 1:
        return fitting[0]
    names = listed(sorted(str(one["name"]) for one in fitting or known)) or "nothing"
    sentence = f"{wanted!r} could be {names}; give the whole name" if fitting else f"no component is called {wanted!r}"
    known_ones = "" if fitting else f"; this team protects {names}"
    raise AgentRefusedError(sentence + known_ones, "UnknownComponentError")


def brief(status: Mapping[str, Any]) -> tuple[str, ...]:
    """One line on all of it, state first; then one for each component that is not well, and each robot that is silent."""
    living = [one for one in status["components"] if sight(one).get("state") not in (*OVER_STATES, "absent")]
    unwell = [one for one in living if is_unwell(one)]
    silent = [peer for peer in status["peers"] if peer["state"] != "live"]
    is_well = is_healthy(status)
    robots = f"{len(status['peers']) + 1 - len(silent)} of {len(status['peers']) + 1} members live"
    head = f"{'healthy' if is_well else 'DEGRADED'}: {robots}, {len(living) - len(unwell)} of {len(living)} components well"
    lines = [f"{one['name']}: {'; '.join((state_of(sight(one)), *_remarks_on(one)[:1]))}" for one in unwell]
    return (head, *lines, *(f"{peer['name']}: {peer['state']}, heard {_heard(peer)}" for peer in silent))


def _heard(peer: Mapping[str, Any]) -> str:
    return "never" if peer.get("last_heard_ms") is None else ago(peer["last_heard_ms"])


def details(component: Mapping[str, Any]) -> list[tuple[str, str]]:
    """All that is known of one component, as lines of a name and a value; what is not known is left out."""
    seen = sight(component)
    kept_there, resumed = component.get("kept") or {}, seen.get("resumed") or {}
    freeze = f"{microseconds(seen.get('freeze_us'))}, at most {microseconds(seen.get('freeze_us_max'))}"
    told = (
        ("state", state_of(seen)),
        ("primary", str(seen.get("primary") or "none")),
        ("standby", standby_of(seen)),
        ("home, preferred", ", ".join(filter(None, (seen.get("home"), seen.get("prefer"))))),
        ("epoch", str(seen.get("epoch") or "")),
        ("checkpoint", f"{milliseconds(seen.get('lag_ms'))} old" if seen.get("lag_ms") is not None else "none"),
        ("freeze", freeze if seen.get("engine") != "cooperative" else ""),
        ("snapshot", f"{size(seen['snapshot_size'])}" if seen.get("snapshot_size") else ""),
        ("kept here", f"{kept_there['checkpoints']} checkpoints, {size(kept_there['size'])}" if kept_there else ""),
        ("restores, crashes", f"{seen.get('restores') or 0}, {seen.get('crashes') or 0}"),
        ("resumed from", f"checkpoint {resumed['sequence']} of {resumed['robot']}" if resumed else ""),
        ("last outage", milliseconds(seen["outage_ms"]) if seen.get("outage_ms") is not None else ""),
        ("engine, pid", ", ".join(str(value) for value in (seen.get("engine"), seen.get("pid")) if value)),
        ("reserved", reserved(component["reserved"]) if component.get("reserved") else ""),
        ("promise", str(seen.get("promise") or "")),
    )
    notes = [("note", line) for line in _remarks_on(component)]
    return [(name, value) for name, value in (*told, *notes) if value]


def reserved(one: Mapping[str, Any]) -> str:
    """By whom, until when by the calendar of the robot that was asked, and why."""
    until = time.strftime("%H:%M:%S", time.localtime(one["until"]))
    return f"by {one['user']} until {until}" + (f" ({one['why']})" if one["why"] else "")


def ending(wait_status: int) -> str:
    """A wait status in words: exit 0, signal 9."""
    number = wait_status & 0x7F
    return f"signal {number}" if number else f"exit {(wait_status >> 8) & 0xFF}"


def mood_of(component: Mapping[str, Any]) -> Mood:
    """How one component is doing."""
    state = component.get("state")
    if state in BAD_STATES:
        return "bad"
    if state in OVER_STATES:
        return "quiet"
    doubtful = not component.get("standby") or is_unprotected(component) or component.get("commit_overdue")
    return "warning" if state in UNSETTLED_STATES or doubtful else "good"


def promises(status: Mapping[str, Any]) -> tuple[str, ...]:
    """The promises that hold now: the team's, and those of components that differ from it."""
    found = [f"promise: {status['promise']}"] if status.get("promise") else []
    for component in map(sight, status["components"]):
        if component.get("promise_differs") and component.get("promise"):
            found.append(f"promise for {component['name']}: {component['promise']}")
    return tuple(found)


def kept(status: Mapping[str, Any]) -> tuple[str, ...]:
    """The checkpoints that a server keeps, and the sealed copies at a witness: of which component, how much, how old."""
    components = status["components"]
    held = [_kept_line(one) for one in components if one.get("kept")] if status.get("role") == "server" else []
    return (*held, *(_sealed_line(one) for one in components if one.get("sealed")))


def _sealed_line(component: Mapping[str, Any]) -> str:
    found = component["sealed"]
    age, at = milliseconds(found["age_s"] * 1_000), found["at"]
    if found["copies"] is None:
        return f"sealed copy at {at}, which is no standby: {component['name']}, {age} old"
    return (
        f"sealed copies, which {at} cannot open: {component['name']}, {found['copies']}, {size(found['size'])}, newest {age} old"
    )


def _kept_line(component: Mapping[str, Any]) -> str:
    found = component["kept"]
    older = f" and {found['older']} older" if found["older"] else ""
    ages = f"{milliseconds(found['newest_age_s'] * 1_000)} to {span(found['oldest_age_s'])} old"
    whose = component.get("primary") or "the first robot that can run it"
    return f"kept for {whose}: {component['name']}, {found['checkpoints']} checkpoints{older}, {size(found['size'])}, {ages}"


def span(seconds: float) -> str:
    """98 ms, 4.2 s, 7 min, 5 h, 3 d."""
    if seconds < HOURS_FROM_S:
        return milliseconds(seconds * 1_000)
    return f"{seconds / 3_600:.0f} h" if seconds < DAYS_FROM_S else f"{seconds / 86_400:.0f} d"


HOURS_FROM_S: Final = 2 * 3_600
DAYS_FROM_S: Final = 2 * 86_400


def memory(status: Mapping[str, Any]) -> tuple[str, ...]:
    """How much of this robot's memory the agent takes, and its bounds."""
    found = status.get("memory")
    if not found:
        return ()
    remembered = f"{size(found['remembered'])} of {size(found['remembered_max'])} remember pages (xor_cache)"
    return (f"memory: agent {size(found['agent'])}, keepers {size(found['keepers'])}; of both {remembered}",)


def ready_copies(status: Mapping[str, Any]) -> tuple[str, ...]:
    """The ready copies at the robot that answered: their memory and their checkpoints, or why there is none."""
    told = [f"{one['name']} {_copy(one['ready_copy'])}" for one in status["components"] if _is_told(one.get("ready_copy"))]
    return (f"ready copy at {status['robot']}: {'; '.join(told)}",) if told else ()


def _is_told(copy: Mapping[str, Any] | None) -> bool:
    return copy is not None and bool(copy["wanted"] and (copy["ready"] or copy["why"]))


def _copy(copy: Mapping[str, Any]) -> str:
    if not copy["ready"]:
        return f"none, because {copy['why']}: a takeover restores it from its chain"
    return f"{size(copy['size'])} of memory, at checkpoint {copy['position']['generation']}.{copy['position']['sequence']}"


def remarks(status: Mapping[str, Any]) -> tuple[str, ...]:
    """The lines below the tree: each cause of trouble once, with the components that it concerns."""
    alike: dict[str, list[tuple[str, str]]] = {}
    for component in status["components"]:
        if sight(component).get("state") != "released":
            name = str(component["name"])
            for line in _remarks_on(component):
                alike.setdefault(_FIGURE.sub("#", line.replace(name, "it")), []).append((name, line))
    found = [_of_all(told) for told in alike.values()]
    found += [f"{peer['name']}: {line}" for peer in status["peers"] for line in peer.get("notes") or ()]
    forged = {reason: count for reason, count in (status.get("beats") or {}).get("refused", {}).items() if reason not in PASSING}
    if forged:
        found.append("beats were refused: " + ", ".join(f"{reason} ({count})" for reason, count in sorted(forged.items())))
    if status.get("insecure"):
        found.append("links are neither authenticated nor encrypted (insecure = true)")
    found += [f"{one['path']} is reserved {reserved(one)}" for one in status.get("reservations") or ()]
    return tuple(found) + tuple(status.get("notes") or ())


_FIGURE: Final = re.compile(r"(?<=\bpid )\d+|\d+(?:\.\d+)?(?= (?:ms|s|min|bytes|KB|MB|GB)\b)")
"""A figure with its unit, or a PID: where sentences differ in these alone, they say the same."""


def _of_all(told: Sequence[tuple[str, str]]) -> str:
    """The sentences on several components as one, with their names."""
    if len(told) == 1:
        return ": ".join(told[0])
    return f"{listed([name for name, _ in told])}: {_in_one([line.replace(name, 'it') for name, line in told])}"


def _in_one(lines: Sequence[str]) -> str:
    """Sentences that differ in figures alone, as one: each PID, and of other figures the least and the most."""
    figures = [sorted(set(told), key=float) for told in zip(*map(_FIGURE.findall, lines), strict=True)]
    told = iter(figures)

    def in_one(found: re.Match[str]) -> str:
        these = next(told)
        if found.string[: found.start()].endswith("pid "):
            return listed(these)
        return these[0] if len(these) == 1 else f"{these[0]}–{these[-1]}"

    return _FIGURE.sub(in_one, lines[0])


def listed(names: Sequence[str]) -> str:
    """a, b and c."""
    return " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))


def _remarks_on(component: Mapping[str, Any]) -> list[str]:
    """Of one component, from every robot that was asked; a cause that another line gives is not given again."""
    sights = {"": component, **(component.get("elsewhere") or {})}
    if component.get("state") in ("ended", "failed"):
        sights = {"": sight(component)}
    lines: list[str] = []
    for robot, seen in sights.items():
        notes = [str(line) for line in seen.get("notes") or ()]
        reasons = [str(line) for line in seen.get("reasons") or ()]
        said = notes + lines
        for line in notes:
            _add(f"{robot}: {line}" if robot and robot not in line else line, line, lines)
        lines += [line for line in reasons[:REASONS_SHOWN] if not any(line in other for other in said)]
    seen = sight(component)
    if is_unknown(seen) and component.get("elsewhere") is not None:
        lines.append(_unknown(seen))
    wanting = seen.get("state") == "degraded" or is_unprotected(seen)
    if seen.get("promise") and not seen.get("promise_differs") and wanting and not is_lacking(seen):
        lines.append(str(seen["promise"]))
    return lines


def _add(told: str, line: str, lines: list[str]) -> None:
    """Add a line. Where another one gives its cause, which stands behind a colon, that one also tells this consequence."""
    what, _, rest = line.partition(": ")
    cause = rest.partition("; ")[0]
    for index, other in enumerate(lines):
        if line == other:
            return
        if len(cause) >= CAUSE_LENGTH_MIN and cause in other:
            lines[index] = other if what in other else f"{other} ({what})"
            return
    lines.append(told)


CAUSE_LENGTH_MIN: Final = 12
"""Characters; fewer may stand in another sentence by chance."""


def _unknown(seen: Mapping[str, Any]) -> str:
    """Where it should run, and that no answer came from there."""
    primary = seen.get("primary")
    if primary:
        return f"{primary}, which runs it, has not answered, so its protection is not known; ask there, or ask again"
    return "no robot that answered runs it; see failover why"


PASSING: Final = frozenset({"unknown key", "seen before, or too old", "from an earlier life of its sender"})
"""Why a beat may be refused also when all is well: a robot has just started, or is heard on two links at once."""

REASONS_SHOWN: Final = 8
"""Of a component that cannot be captured; ``--json`` has them all."""
