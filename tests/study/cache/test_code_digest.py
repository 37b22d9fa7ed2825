"""HVT's own code is named by its content."""

from __future__ import annotations

import json
import shutil
from importlib.metadata import entry_points

import pytest

from hvt_study.cache.results import DETECTING, FLYING, code_digest, flight_code, tree_digest
from hvt_study.runs.run_context import software_versions


def package(root, **files):
    for name, text in {"__init__": "", "tracker": "iou = 0.3\n", **files}.items():
        path = root / "mine" / f"{name.replace('__of__', '/')}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root / "mine"


def test_an_edit_is_another_code(tmp_path):
    """The figures of the old tracker would stand in the new one's table."""
    before = package(tmp_path / "before", report__of__page="a")
    assert tree_digest([package(tmp_path / "copy", report__of__page="a")]) == tree_digest([before])
    assert tree_digest(
        [package(tmp_path / "edit", tracker="iou = 0.4\n", report__of__page="a")]
    ) != tree_digest([before])
    assert tree_digest([package(tmp_path / "more", other="", report__of__page="a")]) != tree_digest([before])
    page = package(tmp_path / "page", report__of__page="b")
    assert tree_digest([page]) != tree_digest([before])
    assert tree_digest([page], without=["mine/report"]) == tree_digest([before], without=["mine/report"])
    (before / "__pycache__").mkdir()
    shutil.copy(before / "tracker.py", before / "__pycache__" / "tracker.pyc")
    assert tree_digest([page], without=["mine/report"]) == tree_digest([before], without=["mine/report"])


def test_what_runs_here_is_in_every_row():
    """Nobody could tell afterwards which HVT gave a table."""
    versions = json.loads(json.dumps(software_versions()))
    assert versions["code"] == flight_code()
    assert len(flight_code()) == 16
    assert code_digest("hvt_common") != flight_code()
    assert {"machine", "pillow", "msgpack"} <= versions.keys()


@pytest.mark.parametrize(
    ("group", "packages"), [("hvt.models", DETECTING), ("hvt.models", FLYING), ("hvt.still_codecs", FLYING)]
)
def test_what_comes_through_a_door_is_code_too(group, packages):
    """A head or a codec would be mended, and the figures of the broken one would stand."""
    own = {one.module.partition(".")[0] for one in entry_points(group=group) if one.dist.name == "hvt"}
    assert own
    assert own <= set(packages)
