"""A status as an agent gives it (`failover.client.control.STATUS`), for tests of what is made of it."""

from __future__ import annotations

from typing import Any


def component(**fields: Any) -> dict[str, Any]:
    """One that runs protected at robot1, with other ``fields`` in place."""
    return {
        "name": "/lab/robot1/count",
        "role": "primary",
        "primary": "robot1",
        "home": "robot1",
        "prefer": "",
        "state": "running",
        "protection": "protected",
        "epoch": 1,
        "standby": "robot2",
        "owner": 1000,
        "lag_ms": 80.2,
        "freeze_us": 900,
        "freeze_us_max": 1900,
        "promise": "If robot1 dies now, robot2 resumes it.",
        "lacks": None,
        "contested": [],
        "reasons": [],
        "notes": [],
        "elsewhere": {},
    } | fields


def status(*components: dict[str, Any], **fields: Any) -> dict[str, Any]:
    """Of robot1, which hears robot2."""
    peer = {"name": "robot2", "role": "robot", "state": "live", "last_heard_ms": 12, "hears_us": True, "load": 1}
    return {
        "robot": "robot1",
        "team": "lab",
        "role": "robot",
        "version": "0.1.0",
        "life": 2,
        "healthy": True,
        "promise": "If one robot dies now, the other resumes its programs.",
        "notes": [],
        "memory": {"agent": 1000, "keepers": 2000, "remembered": 0, "remembered_max": 9},
        "descriptors": {"worker": 40, "main_loop": None},
        "beats": {
            "sent": 9,
            "heard": 8,
            "unsent": 0,
            "refused": {"unknown sender": 2},
            "late_us_max": 15,
            "gap_us_max": 20,
            "gaps": 0,
        },
        "links": [{"name": "wire", "medium": "wired", "carrier": True, "bytes_in": 5, "bytes_out": 6}],
        "peers": [peer | {"beats_lost": 1, "links": ["wire"], "lane": "connected", "doubted": False, "notes": []}],
        "components": list(components),
    } | fields
