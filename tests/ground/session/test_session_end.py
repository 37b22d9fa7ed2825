"""What a session leaves behind at the ground when it has ended: its numbers, and nothing large."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from hvt_common.inference.retried import RetriedDetector
from hvt_common.video.hevc import BaseDecoder
from hvt_ground.config import GroundConfig, check
from hvt_ground.perception.pipeline import DecodedFrame
from hvt_ground.wiring import Models
from rigs.flight import Flight, pipeline_of


def test_pictures_are_let_go_of():
    """A ground whose edges come and go would grow by a hundred megabytes each time."""
    flight, decoder, pipeline = Flight(6), BaseDecoder(), pipeline_of(lambda _event: None)
    for unit in flight.units:
        image = decoder.decode(unit.data)
        pipeline.analyze(DecodedFrame(unit.frame_index, unit.capture_ns, unit.capture_ns, image), hurry=False)
    assert pipeline.history_bytes > 0
    pipeline.end()
    assert pipeline.history_bytes == 0
    assert pipeline.tracks == 1


def test_all_sessions_take_turns_with_the_same_models():
    """Each edge, and each reconnection, would cost another set of networks, their memory and their threads."""
    models = Models(check(GroundConfig()))
    (detector, classifier), other = models.take(), models.take()
    assert (detector, classifier) == other
    inside, most = [], []
    assert isinstance(detector, RetriedDetector)
    model, found = detector.part, detector.part.detect

    def watched(image):
        inside.append(1)
        most.append(len(inside))
        try:
            return found(image)
        finally:
            inside.pop()

    model.detect = watched
    picture = np.zeros((360, 640, 3), np.uint8)
    with ThreadPoolExecutor(4) as sessions:
        list(sessions.map(detector.detect, [picture] * 8))
    assert most == [1] * 8, "they share buffers"


def test_a_detector_that_remembers_pictures_is_each_ones_own():
    """One flight's background would be the next one's."""
    models = Models(check(GroundConfig(detector="motion", classifier="none")))
    assert models.take()[0] is not models.take()[0]
