"""JavaScript of the page, run by node."""

import json
import os
import shutil
import subprocess
from typing import Any

import pytest

NODE = shutil.which("node")

needs_node = pytest.mark.skipif(NODE is None, reason="needs node (Debian: apt install nodejs)")


def ran(script: str) -> Any:
    done = subprocess.run(
        [str(NODE), "--input-type=module", "-e", script],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
        env=os.environ | {"TZ": "UTC"},
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
