"""What all flights over one sequence are judged by."""

from __future__ import annotations

import cv2
import numpy as np

from hvt_scene import Scene
from hvt_study.runs.run_context import open_run_context
from hvt_study.runs.spec import ModelChoice, RunSpec


def test_the_reference_sees_no_less_than_the_edge_does(tmp_path):
    """What the edge truly finds in tiles of the source would be called false."""
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    town = np.tile(Scene(0).image(0.0), (1, 2, 1))  # 3840x1080
    cv2.imwrite(str(pictures / "000000.png"), town)
    spec = RunSpec(
        dataset=f"clips:{pictures}",
        sequence="pictures",
        method="M0",
        regime="200kbps",
        budget_bps=200_000,
        models=ModelChoice("aerial-nano", "aerial-nano"),
        size=(640, 360),
    )
    context = open_run_context(spec, cache=tmp_path / "cache")
    whole = context.detector.detect(town)
    assert len(context.labels[0]) > 1.2 * (whole.confidences >= 0.25).sum() > 0
    assert context.labels[0].boxes_xyxy_px.max() > 1920, "in pixels of the source"
