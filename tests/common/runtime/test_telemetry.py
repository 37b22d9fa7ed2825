"""HVT speaks over its link and nowhere else."""

import os

from programs.processes import python

SEE = """
import sys
import numpy as np
assert "onnxruntime" not in sys.modules
from hvt_common.inference.detect import open_detector
found = open_detector("aerial-nano", threads=1, provider="cpu").detect(np.zeros((96, 160, 3), np.uint8))
print(len(found.confidences))
"""


def test_a_network_that_runs_leaves_and_sends_nothing(tmp_path):
    """Onnxruntime would upload over a 300 kbps radio, and keep an identifier and a file in the home folder."""
    home = tmp_path / "home"
    home.mkdir()
    # Where tests run for somebody's CI, or under pytest, onnxruntime is silent by itself: here it must not know.
    known = {
        name: value for name, value in os.environ.items() if name in ("PATH", "LD_LIBRARY_PATH", "PYTHONPATH")
    }
    done = python(SEE, env={**known, "HOME": str(home)}, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= 0
    assert not [path for path in home.rglob("*") if path.is_file()]
