"""What the command lines import before they know what to do."""

import pytest

from programs.processes import python

HEAVY = {
    *("av", "onnxruntime", "zenoh", "rich", "rerun", "json5", "openvino"),
    *("hvt_edge.app", "hvt_ground.app"),
}


@pytest.mark.parametrize(
    ("asked", "heavy"),
    [
        ("import hvt_edge.cli", HEAVY),
        ("import hvt_ground.cli", HEAVY),
        ("import hvt_study.commands.compare", {"sklearn", "matplotlib"}),
        ("from hvt_ground.extras import config_class; config_class()", {"rerun", "onnxruntime", "zenoh"}),
        # Where Rerun is not installed they say so.
        ("import hvt_archive.joined, hvt_archive.screenshot", {"rerun"}),
    ],
)
def test_a_command_line_imports_what_its_settings_need_and_no_more(asked, heavy):
    """``--help``, a wrong setting and a script that asks for the status would take a second of a small board."""
    code = f"import sys; {asked}; print(*sys.modules)"
    done = python(code)
    assert heavy & set(done.stdout.split()) == set()
