"""The demo's picture."""

import cv2
import numpy as np
import pytest

from hvt_study.datasets.labels import FrameLabels
from hvt_study.demo.picture import Pair, Panel, write_picture
from hvt_study.metrics.judged import FrameView


@pytest.mark.parametrize(("panels", "pairs"), [(1, 0), (1, 3), (3, 1)])
def test_any_number_of_flights_and_stills_makes_a_picture(tmp_path, panels, pairs):
    """After half an hour's flights a traceback would come in place of the table."""
    grey = np.full((360, 640, 3), 90, np.uint8)
    panel = Panel("auto", grey, FrameView.plain([[300, 150, 340, 190]], ["car"]), FrameLabels())
    pair = Pair(grey[:20, :30], grey[:80, :90], "not read", "AB12")
    write_picture(tmp_path / "demo.png", [panel] * panels, [pair] * pairs)
    picture = cv2.imread(str(tmp_path / "demo.png"))
    assert picture is not None
    assert picture.shape[1] >= max(640 * panels, 308 * pairs)
