"""Alerts and dashboard name metrics that there are."""

import re
import shutil
import subprocess

import pytest

from rigs.watched_flight import MAY_LACK, PROMETHEUS, asked_metrics, with_value


@pytest.mark.integration
def test_every_metric_that_is_asked_for_is_told_in_flight(watched):
    """An alert on a name that is misspelt, or that never has a value, never fires."""
    asked, told = asked_metrics(), watched.flying.metrics + watched.at_ground
    assert len(asked) > 25
    assert asked - MAY_LACK - with_value(told) == set()
    assert set(re.findall(r"^# TYPE (\w+)", told, re.MULTILINE)) >= MAY_LACK & asked


def test_prometheus_reads_the_alerts():
    """It refuses to start with a file of rules that it cannot read."""
    promtool = shutil.which("promtool")
    if promtool is None:
        pytest.skip("promtool is not installed: Debian's package prometheus has it")
    done = subprocess.run(
        [promtool, "check", "rules", str(PROMETHEUS / "alerts.yml")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
