"""What browsers load."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

import hvt_web

STATIC = Path(hvt_web.__file__).parent / "static"


@pytest.mark.skipif(shutil.which("tsc") is None, reason="needs tsc (Debian: apt install node-typescript)")
def test_the_types_of_the_page_hold():
    """A message that lost a field would show as a page that stands still, in some browser, some day."""
    options = ("--noEmit", "--allowJs", "--checkJs", "--strict", "--target", "es2022", "--module", "es2022")
    checked = subprocess.run(
        ["tsc", *options, "--lib", "es2022,dom,dom.iterable", STATIC / "main.js"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert checked.returncode == 0, checked.stdout


def test_every_file_comes_from_the_ground():
    """A page at the end of a thin link, or in a closed network, would wait for the rest of the world."""
    names = {path.name for path in STATIC.iterdir()}
    assert {"index.html", "main.js", "page.css"} <= names
    for path in STATIC.iterdir():
        elsewhere = [
            line
            for line in path.read_text().splitlines()
            if "://" in line and "http://www.w3.org/2000/svg" not in line and "location.protocol" not in line
        ]
        assert not elsewhere, path.name
