"""Edge and ground as real processes on a link that is good, at few frames a second."""

import pytest

from programs.processes import Link

pytestmark = [pytest.mark.nightly, pytest.mark.integration]

EDGE = (
    "--source-fps", "15", "--fps", "5", "--size", "640x360", "--budget", "500kbps", "--video-share", "0.6",
    "--detector", "motion", "--detect-every", "1", "--cooldown", "0s", "--method", "M5",
    "--preset", "ultrafast", "--max-frames", "40",
)  # fmt: skip


def test_stills_find_their_moment_between_few_frames(tmp_path, scene):
    """Right behind a base frame the link is busy: at five a second no still would ever go, on the best of links."""
    with Link(tmp_path) as link:
        link.ground("--once", "--detector", "motion", "--classifier", "none")
        summary = link.edge("--source", str(scene), *EDGE).finish()
    assert summary["stills"]["sent"] >= 3, "how many more is a matter of the machine"
