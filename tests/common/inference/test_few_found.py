"""The hint that another model may know this view: once, and only where the embedded detector finds little."""

from __future__ import annotations

import numpy as np
import pytest

from hvt_common.inference.few_found import FewFoundHint
from hvt_common.values import Detections


def found(confidence: float) -> Detections:
    """One detection."""
    return Detections(
        np.array([[0, 0, 9, 9]], np.float32), np.array([confidence], np.float32), np.zeros(1, np.int32)
    )


def said(caplog, detector: str, looks: list[Detections]) -> list[str]:
    """What is logged over these looks."""
    hint = FewFoundHint(detector, confidence=0.25)
    for look in looks:
        hint.take(look)
    return [record.getMessage() for record in caplog.records]


@pytest.mark.parametrize("weak", [Detections.none(), found(0.2)])
def test_a_view_that_it_does_not_know(caplog, weak):
    """A first user would see an empty picture, and take HVT for broken."""
    sentences = said(caplog, "aerial-nano", [*[weak] * 96, found(0.9), *[weak] * 200])
    assert len(sentences) == 1
    assert "aerial-nano found something on 0 of the first 45 pictures" in sentences[0]
    assert "hvt-models fetch yolox-s" in sentences[0]


def test_a_view_that_it_knows_or_a_flight_that_is_young(caplog):
    """A hint that is wrong is worse than none."""
    looks = [found(0.9), *[Detections.none()] * 8]
    assert said(caplog, "aerial-nano", looks * 20) == []
    assert said(caplog, "aerial-nano", [Detections.none()] * 44) == []


@pytest.mark.parametrize("detector", ["motion", "boat.onnx", "yolox-s", "acme-blobs:x"])
def test_who_chose_a_model_needs_no_advice(caplog, detector):
    """Somebody who looks for boats would be sent to a model of cars."""
    assert said(caplog, detector, [Detections.none()] * 100) == []
