"""What the command lines import before they know what to do."""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = {
    "av",
    "onnxruntime",
    "zenoh",
    "rich",
    "rerun",
    "filelock",
    "json5",
    "openvino",
    "hvt_edge.app",
    "hvt_ground.app",
}


@pytest.mark.parametrize("module", ["hvt_edge.cli", "hvt_ground.cli"])
def test_a_command_line_imports_what_its_settings_need_and_no_more(module):
    """``--help``, a wrong setting and a script that asks for the status would take a second of a small board."""
    code = f"import sys, {module}; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=60
    )
    assert HEAVY & set(done.stdout.split()) == set()
