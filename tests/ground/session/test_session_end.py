"""What a session leaves behind at the ground when it has ended: its numbers, and nothing large."""

from __future__ import annotations

from hvt_common.protocol.messages import Info
from hvt_common.video.hevc import BaseDecoder
from hvt_ground.config import GroundConfig, check
from hvt_ground.perception.pipeline import DecodedFrame, Pipeline
from hvt_ground.wiring import Models, make_pipeline
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


def test_the_next_session_gets_the_same_models():
    """Each reconnection would cost another set of networks, their memory and their threads."""
    models = Models(check(GroundConfig()))
    first, other = models.take(), models.take()
    assert first[0] is not other[0]
    models.give_back(*first)
    again = models.take()
    assert again[0] is first[0]
    assert again[1] is first[1]


def eyes_of(config: GroundConfig) -> tuple[Models, Pipeline, Info]:
    """The pipeline of a session of an edge."""
    models, info = Models(config), Flight(1).info()
    return models, make_pipeline(config, models, info=info, emit=lambda _event: None), info


def test_what_looks_at_the_past_uses_the_models_of_now():
    """The first still of an outage would stop the picture for as long as it takes to load a network."""
    models, pipeline, info = eyes_of(check(GroundConfig()))
    for _ in range(2):  # twice at a time: a stretch of video waits while a still is read
        with models.checkout(info.edge) as (detector, classifier), models.checkout(info.edge) as again:
            assert again == (detector, classifier)
    with models.checkout("uav-9") as other:
        assert other[0] is not detector, "another edge's is used by another thread"
    pipeline.end()
    assert {id(models.take()[0]), id(models.take()[0])} == {id(detector), id(other[0])}


def test_a_detector_of_motion_does_not_see_the_past():
    """The picture of now would be compared with one of an hour ago: all of it moves."""
    models, pipeline, info = eyes_of(check(GroundConfig(detector="motion", classifier="none")))
    with models.checkout(info.edge) as (detector, classifier):
        with models.checkout(info.edge) as (another, _):
            assert another is not detector
        assert classifier is None
    pipeline.end()


def test_a_detector_that_remembers_the_scene_is_not_passed_on():
    """One flight's background would be the next one's."""
    models = Models(check(GroundConfig(detector="motion", classifier="none")))
    first = models.take()
    models.give_back(*first)
    assert models.take()[0] is not first[0]
