"""Alerts and dashboard name metrics that there are."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import time
from pathlib import Path

import pytest
import yaml

from hvt_ground.metrics import metrics_text
from hvt_ground.state import StateMaker

FOLDER = Path(__file__).resolve().parents[2] / "deploy" / "prometheus"
_METRIC = re.compile(r"\bhvt_\w+")


def queries() -> list[str]:
    """All that alerts and dashboard ask for."""
    groups = yaml.safe_load((FOLDER / "alerts.yml").read_text())["groups"]
    panels = json.loads((FOLDER / "dashboard.json").read_text())["panels"]
    return [rule["expr"] for group in groups for rule in group["rules"]] + [
        target["expr"] for panel in panels for target in panel["targets"]
    ]


def test_every_metric_that_is_asked_for_is_there():
    """An alert on a name that is misspelt never fires."""
    text = metrics_text(StateMaker(time.time_ns).make([])).decode()
    named = set(re.findall(r"^# TYPE (\w+)", text, re.MULTILINE))
    asked = {name for query in queries() for name in _METRIC.findall(query)}
    assert len(asked) > 10
    assert asked <= named


def test_panels_do_not_overlap():
    """Grafana would move them about."""
    panels = json.loads((FOLDER / "dashboard.json").read_text())["panels"]
    places = [(one["gridPos"]["x"], one["gridPos"]["y"]) for one in panels]
    assert len(set(places)) == len(places) == len({one["id"] for one in panels})


def test_prometheus_reads_the_alerts():
    """It refuses to start with a file of rules that it cannot read."""
    promtool = shutil.which("promtool")
    if promtool is None:
        pytest.skip("promtool is not installed: Debian's package prometheus has it")
    done = subprocess.run(
        [promtool, "check", "rules", str(FOLDER / "alerts.yml")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
