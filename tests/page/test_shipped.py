"""What lies beside the page: the dashboard and the document know each metric that there is, the unit is as closed as it says."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

import page
from page import exposition
from tests.page import prometheus_text
from tests.page.status import component, status
from tests.page.test_exposition import ITEM, TASK, told

ROOT = Path(__file__).parents[2]
UNIT = ROOT / "systemd" / "failover-page.service"
EXPOSURE_MAX = 2.0


def families() -> set[str]:
    """Every metric that can be told."""
    moving = {field: 1.0 for _, field, *_ in exposition.OF_COMPONENTS}
    one = component(**moving, kept={"checkpoints": 1, "size": 1})
    return set(prometheus_text.read(told(status(one), [ITEM | {"age_max_ms": 1}], [TASK | {"took_p50_ns": 1}])))


def test_the_dashboard_asks_for_metrics_that_there_are() -> None:
    dashboard = json.loads((Path(page.__file__).parent / "grafana.json").read_text())
    asked = {
        name for text in re.findall(r'"expr": "(.*?)"[,}\n]', json.dumps(dashboard)) for name in re.findall(r"failover_\w+", text)
    }
    assert len(dashboard["panels"]) >= 10 and len(asked) > 12
    assert asked <= families()


def test_the_document_names_every_metric_and_no_other() -> None:
    table = (ROOT / "docs" / "page.md").read_text().split("| metric, without")[1].split("\n\n")[0]
    named = {f"failover_{name}" for name in re.findall(r"`([a-z_]+)`", table.replace('`part="0.99"`', "")) if name != "failover_"}
    aside = {"failover_component_role", "failover_component_state"}  # named again to explain them
    assert named - aside == families() - aside and aside <= named


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_the_service_is_as_closed_as_its_document_says() -> None:
    command = [
        "systemd-analyze",
        "security",
        "--offline=true",
        "--no-pager",
        f"--threshold={round(EXPOSURE_MAX * 10)}",
        str(UNIT),
    ]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    found = re.search(r"exposure level for \S+: ([\d.]+)", ran.stdout)
    assert ran.returncode == 0 and found is not None, ran.stdout[-300:] + ran.stderr
    assert float(found[1]) <= EXPOSURE_MAX
