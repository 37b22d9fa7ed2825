"""A model whose run raises: the ground goes on without boxes or names, says so once, and opens it again."""

import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper

from hvt_common.inference.retried import RetriedDetector
from hvt_common.protocol.messages import RoiHeader
from hvt_common.runtime.failures import RetryPause
from hvt_common.video.hevc import BaseDecoder
from hvt_ground.config import GroundConfig, check
from hvt_ground.events import Event, Overlay, Refinement
from hvt_ground.perception.models import Models
from hvt_ground.perception.pipeline import DecodedFrame, Pipeline, ReceivedStill
from hvt_ground.perception.session import SessionPerception
from media.onnx_models import colour_classifier, colour_detector
from rigs.flight import Flight, pipeline_of


def fragile(path: Path, *, bright: float, dark: bool = False) -> Path:
    """Have the model's run raise in ONNX Runtime itself where the largest input is ``bright`` or more.

    With ``dark`` where it is less.
    """
    model = onnx.load(path)
    image = model.graph.input[0].name
    output = model.graph.output[0].name
    for node in model.graph.node:
        node.output[:] = ["sound" if name == output else name for name in node.output]
    constants = {"bright": np.array(float(bright), np.float32), "one": np.zeros(1, np.float32)}
    model.graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in constants.items())
    model.graph.node.extend(
        [
            helper.make_node("ReduceMax", [image], ["most"], keepdims=0),
            helper.make_node("Div", ["bright", "most"] if dark else ["most", "bright"], ["share"]),
            helper.make_node("Cast", ["share"], ["place"], to=onnx.TensorProto.INT64),
            helper.make_node("Gather", ["one", "place"], ["nothing"]),  # there is no place 1
            helper.make_node("Add", ["sound", "nothing"], [output]),
        ]
    )
    onnx.checker.check_model(model)
    onnx.save(model, path)
    return path


def picture(index: int, *, value: int) -> DecodedFrame:
    """A grey frame with a red square."""
    image = np.full((192, 320, 3), min(value, 60), np.uint8)
    image[64:128, 64:128] = (0, 0, value)
    return DecodedFrame(index, index * 66_000_000, index * 66_000_000, image)


def opened(detector: Path, classifier: object, **more: Any) -> tuple[Models, list[Event], Pipeline]:
    settings = {"detector": str(detector), "classifier": str(classifier), "provider": "cpu", **more}
    config, events = check(GroundConfig(**settings)), list[Event]()
    models = Models(config)
    return models, events, SessionPerception(config, models, Flight(1).info()).pipeline(events.append)


def test_the_picture_goes_on_without_boxes_and_they_come_back(tmp_path: Path, caplog, monkeypatch) -> None:
    """A detector that stumbles over one picture would end the flight."""
    over = [False]
    monkeypatch.setattr(RetryPause, "due", lambda *_: over[0])
    detector = fragile(colour_detector(tmp_path / "d.onnx", "yolox"), bright=220)
    classifier = fragile(colour_classifier(tmp_path / "c.onnx"), bright=1_000)
    models, events, pipeline = opened(detector, classifier, confidence=0.3, detect_every=5)

    def boxes(index: int, value: int) -> int:
        pipeline.analyze(picture(index, value=value), hurry=False)
        (shown,) = [one for one in events if isinstance(one, Overlay) and one.frame_index == index]
        return len(shown.track_ids)

    assert boxes(0, 200) >= 1
    assert [boxes(index, 255) for index in range(1, 12)][-1] == 0
    (failed,) = models.failures.parts
    assert (failed.part, failed.working, failed.count) == ("detector", False, 1), "it rests for a while"
    assert "out of data bounds" in failed.reason
    over[0] = True
    assert max(boxes(index, 200) for index in range(12, 24)) >= 1, "it was opened again"
    assert models.failures.parts[0].working
    first, last = (one for one in caplog.records if one.name.endswith("failures"))
    assert (first.getMessage()[:10], first.levelno) == ("detector: ", logging.WARNING)
    assert last.getMessage() == "detector: works again"
    pipeline.end()


@pytest.mark.parametrize("part", ["classifier", "detector"])
def test_a_still_is_shown_though_nobody_can_name_it(tmp_path: Path, part: str) -> None:
    """The look that the operator asked for would be lost with the classifier."""
    detector, named = colour_detector(tmp_path / "d.onnx", "yolox"), Path("detector")
    if part == "classifier":  # tried with noise
        named = fragile(colour_classifier(tmp_path / "c.onnx"), bright=2.8, dark=True)
    else:  # tried with grey
        fragile(detector, bright=180)
    models, events, pipeline = opened(detector, named)
    pipeline.analyze(picture(0, value=200), hurry=False)
    item = Flight(1).still(0, 0)
    header = replace(RoiHeader.parse(item.attachment, item.payload), frame_index=0)
    pipeline.read([ReceivedStill(header, item.payload)])
    (shown,) = [one for one in events if isinstance(one, Refinement)]
    assert shown.still == item.payload
    assert pipeline.counts.outcomes == {"unread": 1}
    assert [one.part for one in models.failures.parts] == [part]
    pipeline.end()


def test_a_session_begins_though_the_files_of_the_models_are_gone(tmp_path: Path) -> None:
    """A ground whose models were cleared away, or brought up to date, would record no edge that comes later."""
    files = colour_detector(tmp_path / "d.onnx", "yolox"), colour_classifier(tmp_path / "c.onnx")
    config = check(GroundConfig(detector=str(files[0]), classifier=str(files[1]), provider="cpu"))
    models, info = Models(config), Flight(1).info()
    models.take()
    for one in files:
        one.unlink()
    SessionPerception(config, models, info).pipeline(lambda _: None).end()
    SessionPerception(config, models, info).track(lambda _: None)


# What a session leaves behind at the ground when it has ended: its numbers, and nothing large.


def test_pictures_are_let_go_of():
    """A ground whose edges come and go would grow by a hundred megabytes each time."""
    flight, decoder, pipeline = Flight(6), BaseDecoder(), pipeline_of(lambda _event: None)
    for unit in flight.units:
        image = decoder.decode(unit.data)
        pipeline.analyze(DecodedFrame(unit.frame_index, unit.capture_ns, unit.capture_ns, image), hurry=False)
    assert pipeline.counts.history_bytes > 0
    pipeline.end()
    assert pipeline.counts.history_bytes == 0
    assert pipeline.counts.tracks == 1


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
