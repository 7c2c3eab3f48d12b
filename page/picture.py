"""What the page shows of the team, as a flat table: key → fields. Pure: answers of the agent in, values for JSON out.

Keys are ``team``, and ``KIND:NAME`` for robots, links, components, tasks, drivers, items, people and orders. A client gets
the whole table once, then `changes`: so each field stands still while nothing happens, or is a figure that people look at.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from msgspec import Struct

from failover.client.health import OVER_STATES, is_lacking, is_unknown, is_unprotected, sight
from page.radio import of_media

Table = dict[str, dict[str, Any]]

PROTECTED, DEGRADED, ALONE, FAILED, UNKNOWN = "protected", "degraded", "alone", "failed", "unknown"

SHOWN: Final = tuple(
    """
    name role primary home prefer state protection epoch generation sequence engine pid standby period_ms commit_usual_ms
    commit_overdue freeze_us freeze_us_max freeze_budget_missed slack snapshot_size dirty_bytes snapshots restores crashes
    outage_ms restarts exit_status promise promise_differs kept unstored lacks contested owner reasons output output_waiting notes
    warm cold ready
    """.split()  # noqa: SIM905
)
"""Fields of a component's status that travel as they are."""

MOVING: Final = ("lag_ms", "commit_age_ms")
"""Those that change with each look: rounded, so that a change is one that a person can see."""

OF_A_PEER: Final = ("name", "role", "state", "hears_us", "load", "beats_lost", "links", "lane", "doubted", "notes")
LIVING: Final = ("live", "suspect")


class Answers(Struct, frozen=True):
    """What a user may do: path → why not, "" if he may. What was not asked for he may not."""

    see: Mapping[str, str] = {}
    read: Mapping[str, str] = {}
    operate: Mapping[str, str] = {}
    call: Mapping[str, str] = {}


UNASKED: Final = "the agent has not said yet whether you may"


def changes(before: Mapping[str, Mapping[str, Any]], after: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """What a client that has ``before`` must be told to have ``after``; {} if nothing.

    Returns:
        ``{"set": {key: {field: value}}, "gone": [key], "without": {key: [field]}}``, each only where there is some.
    """
    fresh = {}
    without = {}
    for key, fields in after.items():
        known = before.get(key)
        if known is fields:
            continue
        differs = {name: value for name, value in fields.items() if known is None or name not in known or known[name] != value}
        if differs:
            fresh[key] = differs
        if known is not None and (lost := [name for name in known if name not in fields]):
            without[key] = lost
    gone = [key for key in before if key not in after]
    told = {"set": fresh, "gone": gone, "without": without}
    return {name: value for name, value in told.items() if value}


def of_status(status: Mapping[str, Any], may: Answers) -> Table:
    """Team, robots, links and components, as one user may see them."""
    peers: Sequence[Mapping[str, Any]] = status["peers"]
    robots = [str(peer["name"]) for peer in peers if peer["state"] in LIVING and peer.get("role", "robot") == "robot"]
    robots = sorted([*robots, *([str(status["robot"])] if status.get("role") == "robot" else [])])
    table: Table = {"team": _team(status), f"robot:{status['robot']}": _here(status)}
    table |= {f"robot:{peer['name']}": _peer(peer) for peer in peers}
    table |= of_media(status.get("media") or (), str(status["robot"]))
    for component in map(sight, status["components"]):
        if component.get("state") not in ("released", "absent"):
            table[f"component:{component['name']}"] = of_component(component, robots, may)
    return table


def _team(status: Mapping[str, Any]) -> dict[str, Any]:
    fields = ("robot", "team", "promise", "rule", "fencing", "rights", "healthy", "notes", "version", "insecure", "realtime")
    return {name: status.get(name) for name in fields} | {"away": ""}


def _here(status: Mapping[str, Any]) -> dict[str, Any]:
    beats = status.get("beats") or {}
    return {
        "name": status["robot"],
        "role": status.get("role"),
        "state": "live",
        "here": True,
        "notes": status.get("notes") or [],
        "life": status.get("life"),
        "refused": sum((beats.get("refused") or {}).values()),
        "carriers": {
            link["name"]: f"{link['medium']}, {'up' if link['carrier'] else 'down'}" for link in status.get("links") or ()
        },
    }


def _peer(peer: Mapping[str, Any]) -> dict[str, Any]:
    heard = peer.get("last_heard_ms")
    silent_s = round(heard / 1000, 1) if heard is not None and peer["state"] not in LIVING else None
    return {name: peer.get(name) for name in OF_A_PEER} | {"here": False, "silent_s": silent_s}


def of_component(component: Mapping[str, Any], robots: Sequence[str], may: Answers) -> dict[str, Any]:
    """One component, as its primary tells it where that one answers."""
    word, why = standing(component)
    denied = may.operate.get(str(component["name"]), UNASKED)
    moving: dict[str, Any] = {name: None if (value := component.get(name)) is None else round(value) for name in MOVING}
    reserved = component.get("reserved")
    moving["reserved"] = {part: reserved[part] for part in ("user", "why", "until")} if reserved else None
    orders = {} if component.get("state") is None else _orders(component, robots, denied)
    return {name: component.get(name) for name in SHOWN} | moving | {"word": word, "why": why, "orders": orders}


def standing(component: Mapping[str, Any]) -> tuple[str, str]:
    """How safe it is, in one word for the tree, and the reason; "" where there is nothing to say."""
    state, reasons = str(component.get("state")), [*(component.get("reasons") or ()), *(component.get("notes") or ())]
    reason = str(reasons[0]) if reasons else ""
    if state in OVER_STATES:
        return state, reason
    if state == FAILED:
        return FAILED, reason or "see its event log"
    if is_unknown(component):
        return UNKNOWN, reason or "no robot that answered runs it"
    if state in ("starting", "restarting", "restoring", "held", "frozen"):
        return state, reason
    if not component.get("standby"):
        return ALONE, reason or "no other robot stands by for it"
    if is_lacking(component):
        return DEGRADED, "; ".join(component.get("lacks") or ())
    if is_unprotected(component) or state == DEGRADED:
        return DEGRADED, reason or "no other robot holds a checkpoint of its present state"
    return PROTECTED, ""


# --- Orders: what can be done, and what would follow -----------------------------------------------------------------


def _orders(component: Mapping[str, Any], robots: Sequence[str], denied: str) -> dict[str, dict[str, Any]]:
    """Verb → ``says``, its consequences; ``to``, robots to choose from, or ``target``, the only one; ``why_not``, "" for now."""
    name, primary, state = str(component["name"]), component.get("primary") or "", component.get("state")
    runs = component.get("role") == "primary" and state in ("running", "degraded", "frozen")
    over = state in ("ended", "failed")
    others = [robot for robot in robots if robot != primary]
    home = component.get("prefer") or component.get("home") or ""
    here = f"at {primary}" if primary else "at no robot"
    not_running = "" if runs else f"{name} does not run now"
    nobody = "" if others else "no other robot is heard"
    found: dict[str, dict[str, Any]] = {
        "handover": {"says": f"{name} runs {here}. {_move(component)}", "to": others, "why_not": not_running or nobody},
        "failback": {
            "says": f"{name} runs {here} and moves back to {home}. {_move(component)}",
            "target": home,
            "why_not": not_running or (f"it runs at {home} already" if home == primary else nobody),
        },
        "prefer": {
            "says": f"{name} moves to the robot that you choose, by itself, whenever that robot can run it: also now.",
            "to": robots,
            "why_not": not_running,
        },
        "promote": {
            "says": f"A robot runs {name} from the newest checkpoint that it has, without waiting for robots that are silent.",
            "to": ["", *robots],
            "why_not": f"it runs {here}" if runs else "it has ended" if over else "",
        },
        "stop": {
            "says": f"The program of {name} gets SIGTERM, and SIGKILL after 10 s. No robot runs it again.",
            "why_not": not_running,
        },
        "start": {
            "says": f"{name} starts from its beginning, if agent.toml of its robot declares it.",
            "why_not": "" if over else f"it has not ended: it is {state}",
        },
        "reserve": {
            "says": f"For so long only you give orders about {name}. A takeover asks nothing.",
            "asks": ["minutes", "why"],
            "why_not": "",
        },
        "unreserve": {
            "says": f"Other users may give orders about {name} again.",
            "why_not": "" if component.get("reserved") else "it is not reserved",
        },
        "release": {
            "says": f"{_fate(runs)} All robots forget the checkpoints of {name}: if {primary or 'its robot'} dies, it is lost.",
            "why_not": "",
        },
    }
    return {verb: {**one, "why_not": denied or one["why_not"], "denied": bool(denied)} for verb, one in found.items()}


def _fate(runs: bool) -> str:
    return "The program runs on, without protection." if runs else "The component leaves the team's list."


def _move(component: Mapping[str, Any]) -> str:
    """What a planned move means to the program."""
    freeze_us = component.get("freeze_us_max") or component.get("freeze_us")
    still = f"at least {max(round(freeze_us / 1000), 1)} ms" if freeze_us else "for a moment"
    return (
        f"It stands still {still}, while its last changes travel, and goes on where it was: no work is lost. "
        "Its connections with other programs end, unless its rule carries them."
    )


# --- What is beside the agent's answer -------------------------------------------------------------------------------


def of_tasks(tasks: Iterable[Mapping[str, Any]], status: Mapping[str, Any], owners: Mapping[str, str], may: Answers) -> Table:
    """Tasks of this robot's schedule: who sees the component sees its task, who sees the robot a task of no component."""
    found: Table = {}
    for one in tasks:
        owner = owners.get(one["task"], "")
        if may.see.get(owner or f"/{status['team']}/{status['robot']}", UNASKED) == "":
            found[f"task:{one['task']}"] = {**one, "robot": str(status["robot"]), "component": owner}
    return found


def of_items(items: Iterable[Mapping[str, Any]], team: str, may: Answers) -> Table:
    """Items of the board for those who see them, with their values for those who may read them."""
    found: Table = {}
    for one in items:
        if may.see.get(item_path(team, one), UNASKED):
            continue
        because = may.read.get(item_path(team, one), UNASKED)
        shown = one if not because else {**one, "value": None, "complaint": because}
        found[f"item:{one['robot']}/{one['item']}"] = dict(shown)
    return found


def item_path(team: str, item: Mapping[str, Any]) -> str:
    """Where an item stands for the rules of rights."""
    return f"/{team}/{item['robot']}/{item['item']}"


def of_drivers(places: Iterable[Mapping[str, Any]], may: Answers) -> Table:
    """Drivers that this page can reach, for those who see them, with the reason why this user may not call them."""
    paths = {str(one["path"]): one for one in places}
    seen = {path: one for path, one in paths.items() if may.see.get(path, UNASKED) == ""}
    return {f"driver:{path}": {**one, "why_not": may.call.get(path, UNASKED)} for path, one in seen.items()}
