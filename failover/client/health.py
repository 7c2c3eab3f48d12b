"""Health of a component and of the team: from the words of every robot of the team, so that all answer the same.

Pure: `failover.client.control.STATUS` in, words out. Every robot gets the same input: its own view and the others' views
(``elsewhere``). So the answer may not depend on which of them is the robot's own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

BAD_STATES: Final = frozenset({"degraded", "failed"})
OVER_STATES: Final = frozenset({"ended", "released"})
"""No robot is expected to run a component in one of these states any more."""

UNWELL_STATES: Final = BAD_STATES | {"frozen"}
"""With that of a component that its robot holds still: it acts nowhere."""

Sight = Mapping[str, Any]
"""One component, as one robot sees it."""


def sights(component: Sight) -> Iterator[Sight]:
    """The component as each robot sees it that was asked and answered."""
    yield component
    yield from (component.get("elsewhere") or {}).values()


def sight(component: Sight) -> Sight:
    """The component as the robot sees it that runs or ran it, where that one was asked; otherwise as the asked robot does.

    With the needs that its standby does not meet, as that one says.
    """
    elsewhere = component.get("elsewhere") or {}
    seen = max(sights(component), key=lambda one: (one.get("epoch") or 0, one.get("role") == "primary"))
    seen = seen if seen.get("role") == "primary" else _of_primary(seen, elsewhere)
    standing_by = elsewhere.get(seen.get("standby"), component)
    return {**seen, "lacks": standing_by.get("lacks"), "prepared_first": standing_by.get("prepared_first")}


def _of_primary(seen: Sight, elsewhere: Mapping[str, Sight]) -> Sight:
    """The word on it of the robot that others take for its primary, where that one agrees."""
    primary = seen.get("primary")
    theirs: Sight = elsewhere.get(primary, {}) if primary else {}
    return theirs if theirs.get("primary") == primary else seen


def is_lacking(component: Sight) -> bool:
    """Its standby would refuse it, and no hook brings the lacking things."""
    return bool(component.get("lacks")) and not component.get("prepared_first")


def is_unprotected(component: Sight) -> bool:
    """It runs, and no robot could go on with its present state."""
    checkpointed = component.get("protection") not in ("none", "stopped")
    is_refused = is_lacking(component) or bool(component.get("contested"))
    return component.get("role") == "primary" and (not checkpointed or is_refused)


def is_unknown(component: Sight) -> bool:
    """No robot that answered runs it: it runs nowhere, or where no answer came from."""
    return component.get("role") != "primary" and component.get("state") not in OVER_STATES | BAD_STATES


def is_unwell(component: Sight) -> bool:
    """It runs nowhere or stands still, unprotected, degraded, or a robot with its checkpoints could not go on from them well."""
    one = sight(component)
    is_bad = one.get("state") in UNWELL_STATES or not one.get("standby") or is_unprotected(one) or is_unknown(one)
    is_over = one.get("state") in OVER_STATES
    return (is_bad and not is_over) or any(
        seen.get("cold") or seen.get("unstored") or is_lacking(seen) for seen in sights(component)
    )


def is_healthy(status: Mapping[str, Any]) -> bool:
    """Whether all that should be protected is, as far as any robot that answered knows.

    No component is degraded, failed, held still, unprotected, without a standby that can run it, or where no answer came from; no
    robot counts a peer as dead, or has lately heard one say more than it may. Where etcd has a vote, it is reached.
    """
    unwell = any(map(is_unwell, status["components"]))
    unwell |= any(peer.get("doubted") for peer in status["peers"]) or any((status.get("doubted_elsewhere") or {}).values())
    unwell |= (status.get("coordinator") or {}).get("state") == "dead"
    peers = {peer["name"]: peer["state"] for peer in status["peers"]}
    return not unwell and all("dead" not in seen.values() for seen in (peers, *(status.get("peers_elsewhere") or {}).values()))
