"""A ground as a real process, whose parts fail in flight."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from media.onnx_models import failing_in_the_light
from programs.processes import Link
from programs.rrd import Recording

pytestmark = [pytest.mark.nightly, pytest.mark.integration]

FLIGHT = (
    *("--source-fps", "10", "--fps", "10", "--size", "320x192", "--preset", "ultrafast"),
    *("--budget", "400kbps"),
)


def clip(folder: Path, values: list[int]) -> Path:
    """Grey pictures of these brightnesses."""
    folder.mkdir()
    for index, value in enumerate(values):
        cv2.imwrite(str(folder / f"{index:04}.png"), np.full((192, 320, 3), value, np.uint8))
    return folder


def test_a_detector_that_fails_leaves_the_video_of_every_edge(link: Link, tmp_path: Path) -> None:
    """One bright picture of one drone would end the flights of all."""
    model = failing_in_the_light(tmp_path / "model.onnx")
    dark = clip(tmp_path / "dark", [30] * 600)
    bright = clip(tmp_path / "bright", [30] * 40 + [200] * 60 + [30] * 500)
    ground = link.ground(
        *("--detector", str(model), "--provider", "cpu", "--classifier", "none", "--detect-every", "1"),
        *("--record", "recordings"),
    )
    edges = [
        link.edge(*FLIGHT, "--source", str(source), "--detector", "motion", "--edge-id", name, name=name)
        for name, source in (("uav-1", bright), ("uav-2", dark))
    ]
    ground.until("detector: ")
    ground.until("detector FAILED at")
    ground.until("detector: works again")
    for one in (*edges, ground):
        assert one.alive
        one.stop()
    sessions = ground.finish()
    sent = {one.name: one.finish() for one in edges}
    assert [one["edge"] for one in sessions] == ["uav-1", "uav-2"]
    for one in sessions:
        assert one["frames_decoded"] == sent[one["edge"]]["frames"] > 0
        assert one["failure"] == ""
        assert [part["part"] for part in one["failed"]] == ["detector"]
        assert len(Recording(Path(link.folder / one["recording"])).video()) == one["frames_decoded"]
    assert ground.said.count("detector: ") <= 4, ground.said
    assert "detector" in ground.told
    assert "Traceback" not in ground.said
