"""Recordings beside each other in one file."""

import subprocess
import sys

from hvt_ground.events import VideoSample
from media.clips import START_NS
from programs.rrd import Recording, recorded


def test_of_a_damaged_recording_the_rest_is_joined(tmp_path):
    """After a power cut a file may end in zeros: it was no recording, and no flight was beside another."""
    samples = [
        VideoSample(frame, START_NS + frame * 66_666_667, b"unit", keyframe=True) for frame in range(4)
    ]
    paths = [recorded(tmp_path / f"{edge}.rrd", samples, edge_id=edge) for edge in ("uav-1", "uav-2")]
    data = paths[1].read_bytes()
    paths[1].write_bytes(data[:-300] + bytes(300))
    out = tmp_path / "all.rrd"
    done = subprocess.run(
        [sys.executable, "-m", "hvt_archive.joined", *paths, "--out", out],
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert f"{paths[1]} is damaged or breaks off: what can be read is joined" in done.stderr
    assert {one.entity_path.split("/")[1] for one in Recording(out).chunks} >= {"uav-1", "uav-2"}
