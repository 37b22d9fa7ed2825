"""The edge's end of the tracks channel."""

import numpy as np

from hvt_common.protocol.messages import TrackStep, TrackStepDecoder
from hvt_common.values import Frame
from hvt_edge.link.tracks_channel import TrackReporter
from hvt_edge.perception.analyzer import AnalyzedFrame
from media.clips import START_NS
from rigs.examples import tracks_of

PIXELS = np.zeros((8, 8, 3), np.uint8)


def seen(
    index: int, *, ages=(0, 0), detected: bool = True, coded: bool = True, fps: float = 15
) -> AnalyzedFrame:
    frame = Frame(index, START_NS + round(index * 1e9 / fps), PIXELS, PIXELS)
    count = len(ages)
    left = 10.0 * np.arange(count) + index
    boxes = np.stack([left, left, left + 20, left + 30], axis=1)
    tracks = tracks_of(index, boxes, classes=range(count), seen=index - np.array(ages))
    return AnalyzedFrame(frame, PIXELS if coded else None, tracks, detected=detected)


class Line:
    """A sender whose budget has room 40 ms later; it makes each message twice, as `Transmitter.status` does."""

    def __init__(self) -> None:
        self.steps: list[TrackStep] = []
        self.full_ns: set[int] = set()
        """Times at which the budget has no room."""

    def metadata(self, _channel, make, *, now_ns):
        if now_ns in self.full_ns:
            return False
        make(now_ns)
        self.steps.append(TrackStep.parse(make(now_ns + 40_000_000)))
        return True


def told(shown: list[AnalyzedFrame], **settings) -> list[TrackStep]:
    line = Line()
    reporter = TrackReporter(line, session_id=77, **settings)
    for one in shown:
        reporter.report(one, now_ns=one.frame.capture_ns + 5_000_000)
    return line.steps


def test_each_decision_step_is_told_and_nothing_else():
    """The ground would lack tracks, or pay for what the detector never saw."""
    steps = told([seen(index, detected=index % 5 == 0, coded=index % 2 == 0) for index in range(31)])
    assert [step.frame_index for step in steps] == [0, 5, 10, 15, 20, 25, 30]
    assert [step.sequence for step in steps] == list(range(7))
    assert {(step.session_id, step.send_delay_ns) for step in steps} == {(77, 45_000_000)}, "the budget's"
    assert [step.reference for step in steps] == [-1, 0, 1, -1, 3, 4, -1]
    decoder = TrackStepDecoder()
    for step in steps:
        got = decoder.decode(step)
        np.testing.assert_allclose(
            got.boxes_xyxy_px[0], seen(step.frame_index).tracks.boxes_xyxy_px[0], atol=1
        )
        assert got.class_ids.tolist() == [0, 1]


def test_no_more_steps_than_allowed():
    """A detector on every frame would fill a thin link with boxes."""
    every = [seen(index) for index in range(45)]
    assert [step.frame_index for step in told(every)] == list(range(0, 45, 5))
    assert len(told(every, most_per_s=1)) == 3
    assert len(told(every, most_per_s=100)) == 45


def test_tracks_that_were_long_not_found_are_left_out_and_an_empty_scene_is_told():
    """Ghosts, or the last tracks for ever, would stand on the operator's screen."""
    decoder = TrackStepDecoder()
    steps = told([seen(20, ages=(0, 6, 5, 19)), seen(25, ages=())])
    assert [decoder.decode(step).ids.tolist() for step in steps] == [[1, 3], []]


def test_a_step_without_room_is_left_out_and_the_next_is_understood():
    """The ground would read changes of a step that it never got, and show no track until the next whole one."""
    line, reader = Line(), TrackStepDecoder()
    reporter = TrackReporter(line, session_id=77, refresh_ns=10**12)
    shown = [seen(index) for index in range(0, 60, 5)]
    line.full_ns = {one.frame.capture_ns for one in shown[2:9:3]}
    sent = [reporter.report(one, now_ns=one.frame.capture_ns) for one in shown]
    assert sent == [number not in (2, 5, 8) for number in range(12)]
    for one, step in zip(
        (one for one, went in zip(shown, sent, strict=True) if went), line.steps, strict=True
    ):
        tracks = reader.decode(step)
        assert tracks is not None
        np.testing.assert_allclose(tracks.boxes_xyxy_px, one.tracks.boxes_xyxy_px, atol=1)
