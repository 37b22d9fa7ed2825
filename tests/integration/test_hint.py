"""A first flight over what the embedded detector does not know."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from programs.processes import Link, Running

pytestmark = [pytest.mark.integration, pytest.mark.nightly]


SAYS = "hvt-models fetch yolox-s"


def fly(link: Link, sky: Path, detector: str, *settings: str) -> tuple[Running, Running]:
    """An edge in real time and its ground, over a sky that grows brighter."""
    sky.mkdir()
    for index in range(900):
        picture = np.full((144, 192, 3), 120 + index // 8, np.uint8)
        cv2.imwrite(str(sky / f"{index:03d}.png"), picture)
    ground = link.ground("--once", "--detector", detector, "--classifier", "none", "--detect-every", "1")
    edge = link.edge(
        *("--source", str(sky), "--source-fps", "10", "--fps", "10", "--size", "192x144", *settings),
        *("--detect-every", "1", "--detector", detector, "--preset", "ultrafast", "--wait", "60s"),
    )
    return edge, ground


def test_both_sides_name_another_model_once(link, tmp_path):
    """A first user would see an empty picture, and take HVT for broken."""
    edge, ground = fly(link, tmp_path / "sky", "aerial-nano")
    for side in (edge, ground):
        side.until(SAYS)
    edge.stop()
    ground.finish()
    for side in (edge, ground):
        assert side.said.count(SAYS) == 1, side.said
