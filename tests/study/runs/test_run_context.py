"""What runs over one sequence share."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hvt_study.datasets.sequence import Clip
from hvt_study.runs.run_context import open_pixels

pytestmark = pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="the system has no /proc")


@pytest.mark.parametrize("shared", [True, False])
def test_a_study_that_is_killed_leaves_no_pixels_behind(tmp_path, monkeypatch, shared):
    """Up to 4 GiB of each process lay in /tmp for ever, if it was stopped while it opened a sequence."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    frame = np.full((48, 64, 3), 7, np.uint8)

    def images(_):
        yield frame
        assert not list(tmp_path.iterdir())
        if not shared:
            raise OSError("no room")
        yield frame + 1

    clip = Clip("demo", (64, 48), 2)
    with monkeypatch.context() as drawn:
        drawn.setattr(Clip, "images", images)
        staged, keeper = open_pixels(clip)
    assert (keeper is not None) is shared
    assert not list(tmp_path.iterdir())
    if shared:
        assert [image[0, 0, 0] for image in staged.images()] == [7, 8]
    assert replace(staged, pixels=None) == clip
