"""A first flight over what the embedded detector does not know."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

pytestmark = [pytest.mark.integration, pytest.mark.timeout(120)]


@pytest.mark.parametrize("detector", ["aerial-nano", "motion"])
def test_both_sides_name_another_model_once(link, tmp_path, detector):
    """A first user would see an empty picture, and take HVT for broken."""
    (tmp_path / "sky").mkdir()
    for index in range(160):
        cv2.imwrite(
            str(tmp_path / f"sky/{index:03d}.png"), np.full((144, 192, 3), 120 + index // 4, np.uint8)
        )
    ground = link.ground("--once", "--detector", detector, "--classifier", "none", "--detect-every", "1")
    edge = link.edge(
        *("--source", str(tmp_path / "sky"), "--source-fps", "10", "--fps", "10", "--size", "192x144"),
        *("--detect-every", "1", "--detector", detector, "--preset", "ultrafast", "--wait", "60s"),
    )
    edge.finish()
    ground.finish(within_s=30)
    for side in (edge, ground):
        assert side.said.count("hvt-models fetch yolox-s") == (detector == "aerial-nano"), side.said
