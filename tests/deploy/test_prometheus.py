"""Alerts and dashboard name metrics that there are."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import urllib.request
from pathlib import Path

import pytest
import yaml

from programs.processes import Link, eventually, free_ports

FOLDER = Path(__file__).resolve().parents[2] / "deploy" / "prometheus"
_METRIC = re.compile(r"\bhvt_\w+")
_DEPENDS = {"hvt_edge_temperature_celsius", "hvt_edge_wireless_dbm", "hvt_part_failed"}
"""On the machine, or on what fails: declared, and without a value in most flights."""


def queries() -> list[str]:
    """All that alerts and dashboard ask for."""
    groups = yaml.safe_load((FOLDER / "alerts.yml").read_text())["groups"]
    panels = json.loads((FOLDER / "dashboard.json").read_text())["panels"]
    return [rule["expr"] for group in groups for rule in group["rules"]] + [
        target["expr"] for panel in panels for target in panel["targets"]
    ]


def told(address: str) -> tuple[set[str], set[str]]:
    """Names that are declared, and those that have a value."""
    try:
        with urllib.request.urlopen(f"http://{address}/metrics", timeout=10) as answer:
            text = answer.read().decode()
    except OSError:
        return set(), set()  # it is starting
    return set(re.findall(r"^# TYPE (\w+)", text, re.MULTILINE)), set(
        re.findall(r"^(hvt_\w+)", text, re.MULTILINE)
    )


@pytest.mark.integration
def test_every_metric_that_is_asked_for_is_told_in_flight(tmp_path, long_scene):
    """An alert on a name that is misspelt, or that never has a value, never fires."""
    asked = {name for query in queries() for name in _METRIC.findall(query)}
    assert len(asked) > 25
    at_ground, at_edge = (f"127.0.0.1:{port}" for port in free_ports(2))
    with Link(tmp_path) as link:
        link.ground("--detector", "motion", "--classifier", "none", "--metrics", at_ground)
        flight = (
            *("--source", str(long_scene), "--size", "640x360", "--fps", "5", "--method", "M5"),
            *("--detector", "motion"),
        )
        store = ("--store", "20MB", "--store-folder", str(tmp_path / "store"))
        link.edge(*flight, *store, "--metrics", at_edge)

        def missing() -> set[str]:
            return asked - _DEPENDS - told(at_ground)[1] - told(at_edge)[1]

        eventually(lambda: not missing(), within_s=60, what="all that is asked for has a value")
        assert told(at_ground)[0] | told(at_edge)[0] >= _DEPENDS & asked


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
