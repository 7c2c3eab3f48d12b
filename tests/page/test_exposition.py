"""Metrics: every line is one that Prometheus takes, whatever components, items and tasks are called."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from page import exposition
from tests.page import prometheus_text
from tests.page.prometheus_text import FormatError
from tests.page.status import component, status

ITEM: dict[str, Any] = {
    "robot": "robot1",
    "item": "ball",
    "age_ms": 12,
    "age_max_ms": None,
    "bound_ms": 120,
    "stale": False,
    "put": 7,
    "lost": 0,
}
TASK: dict[str, Any] = {
    "task": "mapper",
    "started": 9,
    "misses": 1,
    "overruns": 0,
    "skipped": 0,
    "late_p50_ns": 16384,
    "late_p99_ns": 65536,
    "took_p50_ns": 0,
    "took_p99_ns": 0,
}


def told(team: dict[str, Any], items: list[dict[str, Any]], tasks: list[dict[str, Any]]) -> str:
    found = exposition.Exposition()
    exposition.of_team(found, team)
    exposition.of_components(found, team["components"])
    exposition.of_board(found, items)
    exposition.of_tasks(found, tasks)
    exposition.of_page(found, 2, {"done": 3})
    return found.text()


def test_all_of_it_is_read_back() -> None:
    one = component(lag_ms=98.5, freeze_us=1040, epoch=3, snapshots=12, kept={"checkpoints": 2, "size": 4096})
    found = prometheus_text.read(told(status(one), [ITEM], [TASK]))
    name = (("component", "/lab/robot1/count"),)
    assert found["failover_component_epoch"] == {name: 3}
    assert found["failover_component_checkpoint_age_seconds"] == {name: 0.0985}
    assert found["failover_component_freeze_seconds"] == {name: 0.00104}
    assert found["failover_component_protected"] == {name: 1}
    assert found["failover_component_kept_bytes"] == {name: 4096}
    assert found["failover_peer_live"] == {(("peer", "robot2"), ("role", "robot")): 1}
    assert found["failover_link_bytes_total"][(("direction", "in"), ("link", "wire"), ("medium", "wired"))] == 5
    assert found["failover_heartbeats_refused_total"] == {(("reason", "unknown sender"),): 2}
    assert found["failover_board_item_age_seconds"] == {(("item", "ball"), ("of", "robot1")): 0.012}
    assert "failover_board_item_age_max_seconds" not in found, "what is not known is left out"
    assert found["failover_task_misses_total"] == {(("task", "mapper"),): 1}
    assert found["failover_task_lateness_seconds"][(("part", "0.99"), ("task", "mapper"))] == pytest.approx(65536e-9)
    assert found["failover_open_descriptors"] == {(("process", "worker"),): 40}
    assert found["failover_page_orders_total"] == {(("ended", "done"),): 3}


@given(st.text(), st.text())
def test_any_name_is_a_label(name: str, state: str) -> None:
    found = prometheus_text.read(told(status(component(name=name, state=state)), [], []))
    if state not in ("released", "absent"):
        assert (("component", name),) in found["failover_component_epoch"]


@pytest.mark.parametrize(
    "text",
    [
        "failover_x 1\n",
        "# HELP failover_x A\n# TYPE failover_x gauge\nfailover_x 1",
        "# HELP failover_x A\n# TYPE failover_x counter\nfailover_x 1\n",
        "# HELP failover_x A\n# TYPE failover_x gauge\nfailover_x 1\nfailover_x 1\n",
        '# HELP failover_x A\n# TYPE failover_x gauge\nfailover_x{a="\n"} 1\n',
        '# HELP failover_x A\n# TYPE failover_x gauge\nfailover_x{a="1",a="2"} 1\n',
        "# HELP failover_x A\n# TYPE failover_x gauge\nfailover_y 1\n",
        "# HELP failover_x A\n# TYPE failover_x gauge\n",
    ],
)
def test_a_line_that_prometheus_would_refuse_is_seen(text: str) -> None:
    with pytest.raises(FormatError):
        prometheus_text.read(text)
