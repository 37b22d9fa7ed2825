"""The tree stays one that a stranger finds his way in."""

from __future__ import annotations

import ast
import subprocess
from collections import Counter
from pathlib import Path, PurePosixPath

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = (
    "common/hvt_common",
    "edge/hvt_edge",
    "ground/hvt_ground",
    "study/hvt_scene",
    "study/hvt_study",
    "study/hvt_train",
)
MOST_AT_THE_TOP, MOST_IN_A_FOLDER = 8, 14


def modules() -> list[PurePosixPath]:
    """Every Python file that git has; the tests' too."""
    listed = subprocess.run(
        ["git", "ls-files", "*.py"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode:
        pytest.skip("this is no git checkout: nothing says which files are the project's")
    return [PurePosixPath(one) for one in listed.stdout.split()]


def test_no_folder_is_a_corridor():
    """A newcomer would search sixty doors for one."""
    count = Counter(str(one.parent) for one in modules() if one.name != "__init__.py")
    assert {place: number for place, number in count.items() if number > MOST_IN_A_FOLDER} == {}
    assert {place: count[place] for place in PACKAGES if count[place] > MOST_AT_THE_TOP} == {}


def test_every_folder_of_a_package_says_what_happens_there():
    """The tree would have to be explained by somebody who knows it."""
    folders = {one.parent for one in modules() if str(one).startswith(PACKAGES)}
    silent = [
        str(folder)
        for folder in sorted(folders)
        if not ast.get_docstring(ast.parse((ROOT / folder / "__init__.py").read_text(encoding="utf-8")))
    ]
    assert silent == []
