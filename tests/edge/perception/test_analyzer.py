"""What the edge sees of its own stream, and the thread it sees in."""

from dataclasses import replace
from itertools import count

import cv2
import numpy as np
import pytest

from hvt_common.inference.scale_search import ScaleSearch
from hvt_common.inference.view_trust import ViewTrust
from hvt_common.tracking.bytetrack import ByteTracker
from hvt_common.tracking.settings import TrackerSettings
from hvt_common.units import SECOND_NS
from hvt_common.values import View
from hvt_common.video.hevc import YuvPicture
from hvt_edge.config import EdgeConfig, check
from hvt_edge.perception.analyzer import AnalyzedFrame, Analyzer
from hvt_edge.perception.cpu_budget import CpuBudget
from hvt_edge.video.x265 import BaseEncoder, EncoderSettings
from hvt_edge.wiring.perception import make_analyzer
from media.clips import framed, smooth_pictures
from rigs.flight import SIZE, NothingSeen, RedSquares, square_box

NOISE = (
    8
    * cv2.GaussianBlur(np.random.default_rng(0).normal(0, 12, (SIZE[1], SIZE[0], 1)), (0, 0), 1.5)[..., None]
)
FRAMES = [
    # The camera sees a texture that the base does not show.
    replace(frame, source_bgr=np.clip(frame.base_bgr + NOISE, 0, 255).astype(np.uint8))
    for frame in framed(smooth_pictures(30, size=SIZE))
]
UNITS = [
    unit
    for encoder in [BaseEncoder(EncoderSettings(size=SIZE, fps=15, bitrate_bps=120_000, preset="ultrafast"))]
    for unit in map(encoder.encode, FRAMES)
]
VIEW = View.fitted(SIZE, SIZE, fit="letterbox")


def make(*, detector=None, view: View = VIEW, camera_motion="off", kind=ByteTracker, **settings) -> Analyzer:
    tracker = kind(TrackerSettings.starting_at(0.25, camera_motion=camera_motion), fps=15)
    return Analyzer(detector or RedSquares(), tracker, view=view, **settings)


def analyzed(analyzer: Analyzer, frames=FRAMES, units=None) -> list[AnalyzedFrame]:
    return [analyzer.analyze(*one) for one in zip(frames, UNITS if units is None else units, strict=False)]


def searched(seen: list[AnalyzedFrame]) -> list[int]:
    return [one.frame.index for one in seen if one.detected]


def test_every_frame_is_decoded_and_each_nth_is_searched():
    """Candidates would be of other frames than the stills, or the processor would melt."""
    trust, taken = ViewTrust(None, hence=""), []
    trust.take = lambda found: taken.append(len(found))
    analyzer = make(detect_every=5, trust=trust)
    seen = analyzed(analyzer)
    assert searched(seen) == [0, 5, 10, 15, 20, 25]
    assert taken == [1] * 6, "or a view that the detector does not know were never noticed"
    for one in seen[10:]:
        assert one.tracks.frame_index == one.frame.index
        assert one.tracks.ids.tolist() == [1]
        np.testing.assert_allclose(one.tracks.boxes_xyxy_px[0], square_box(one.frame.index), atol=6)
        error = one.base_bgr.astype(int) - one.frame.base_bgr
        assert 0 < np.abs(error).mean() < 6, "the decoded picture, not the camera's"


@pytest.mark.parametrize("candidates", ["decoded", "source"])
def test_small_objects_are_looked_at_enlarged_and_less_often(candidates):
    """They got no still; five runs as often as one would take the whole processor."""
    search = ScaleSearch(RedSquares().detect, confidence=0.25)
    search.enlarged = True
    analyzer = make(detector=NothingSeen(), search=search, detect_every=3, candidates=candidates)
    seen = analyzed(analyzer)
    assert searched(seen) == [0, 9, 18, 21, 24, 27], "in vain at last"
    np.testing.assert_allclose(seen[0].tracks.boxes_xyxy_px[0], square_box(0), atol=6)


@pytest.mark.parametrize(
    ("tiles", "pace", "runs"),
    [("auto", "realtime", 3), ("auto", "lockstep", 2), ("search", "lockstep", 3), ("off", "realtime", 2)],
)
def test_the_scale_is_found_in_real_time_and_where_it_is_wanted(tiles, pace, runs):
    """Objects of a few pixels would get no still, or a study that is repeated other figures."""
    config = check(EdgeConfig(source="demo", candidates="source", tiles=tiles, pace=pace))
    network = NothingSeen()
    analyzer = make_analyzer(config, detector=network, view=VIEW)
    analyzed(analyzer, FRAMES[:6])
    assert network.runs == runs


@pytest.mark.parametrize(
    ("enlarged", "reduces", "share"), [(False, True, 0.5), (True, True, 1), (False, False, 1)]
)
def test_a_slow_machine_searches_a_smaller_input_but_for_small_objects_and_tiles_of_ones_own(
    enlarged, reduces, share
):
    """Boxes of a board were up to six seconds old; those of a few pixels would come and go."""
    shares: list[float] = []

    class Sized(RedSquares):
        def input_size(self, image_size: tuple[int, int]) -> tuple[int, int]:
            return image_size

        def detect(self, image_bgr, *, share: float = 1.0):
            shares.append(share)
            return super().detect(image_bgr)

    now_ns = count(0, 9 * SECOND_NS // 100)
    budget = CpuBudget(fps=15, processors=0.5, spent_ns=lambda: next(now_ns))
    search = ScaleSearch(NothingSeen().detect, confidence=0.25)
    search.enlarged = enlarged
    analyzer = make(detector=Sized(), search=search, detect_every=1, cpu_budget=budget, reduces=reduces)
    analyzed(analyzer)
    assert shares[0] == 1, "nothing is measured yet"
    assert shares[-1] == share


def test_what_nobody_uses_is_not_searched_and_goes_on_from_any_frame():
    """Video alone would pay for tracks that nobody sees; or a request for them would find no picture to build on."""
    detector = RedSquares()
    used, always = make(detector=detector, detect_every=5), make(detect_every=5)
    for frame, unit in zip(FRAMES[:11], UNITS, strict=False):
        passed = used.pass_over(frame, unit)
        expected = always.analyze(frame, unit)
        assert (len(passed.tracks), passed.detected, passed.tracked) == (0, False, False)
    assert (used.frames, used.spent_ns, used.detected_ns) == (0, 0, None)
    for frame, unit in zip(FRAMES[11:20], UNITS[11:20], strict=True):
        seen, expected = used.analyze(frame, unit), always.analyze(frame, unit)
        np.testing.assert_array_equal(seen.base_bgr, expected.base_bgr)
    assert seen.tracks.ids.tolist() == expected.tracks.ids.tolist()


@pytest.mark.parametrize("candidates", ["source", "decoded"])
def test_a_picture_is_converted_where_somebody_looks_at_it(monkeypatch, candidates):
    """Each coded frame would be converted for the one in five that is searched, a twentieth of all work."""
    converted = []
    convert = YuvPicture.bgr
    monkeypatch.setattr(YuvPicture, "bgr", lambda self: converted.append(1) or convert(self))
    seen = analyzed(make(camera_motion="flow", detect_every=5, candidates=candidates))
    assert all(one.base is not None for one in seen)
    looked_at = [one for one in seen if one.detected]
    assert all(one.base_bgr is one.base_bgr for one in looked_at), "once"
    assert len(converted) == len(looked_at) == 6


def test_in_a_hurry_detection_is_put_off_and_made_up_for():
    """A slow detector would fall behind more and more; or a busy second would leave it blind for another."""
    analyzer = make(detect_every=5)
    hurried = {5, 6, 7, 15}
    seen = []
    for frame, unit in zip(FRAMES, UNITS, strict=True):
        analyzer.cpu_budget.queued = 3 * (frame.index in hurried)
        seen.append(analyzer.analyze(frame, unit))
    assert searched(seen) == [0, 8, 13, 18, 23, 28]
    assert all(one.base_bgr.shape == (192, 320, 3) for one in seen)


def test_a_detector_that_is_to_look_rarely_is_not_called_too_slow():
    """With --detect-every 100 auto would send nothing but video, and blame the machine."""
    analyzer = make(detect_every=100)
    for frame, unit in zip(FRAMES, UNITS, strict=True):
        analyzer.cpu_budget.admits_frame(frame.index * SECOND_NS, lost=0, late=False)
        assert not analyzer.cpu_budget.too_slow
        analyzer.analyze(frame, unit)


def test_a_standing_picture_is_searched_less_often_until_something_moves():
    """A hovering drone's processor would go into what it has seen; or a car drive for seconds without a box."""
    analyzer = make(camera_motion="flow", candidates="source", detect_every=5, detect_still_every=15)
    standing = [replace(FRAMES[0], index=index) for index in range(20)]
    seen = analyzed(analyzer, standing + FRAMES[20:])
    assert searched(seen) == [0, 15, 25]


def test_another_scene_is_searched_at_once():
    """Boxes of the scene before, and its tracks, went to the ground until the next look was due."""
    other = np.random.default_rng(2).integers(0, 2, (6, 10, 3), np.uint8) * 200
    other = cv2.resize(other, SIZE, interpolation=cv2.INTER_CUBIC)
    other[100:132, 50:82] = (20, 20, 220)
    switched = [replace(frame, source_bgr=other, base_bgr=other) for frame in FRAMES[4:12]]
    seen = analyzed(make(camera_motion="flow", detect_every=8, candidates="source"), FRAMES[:4] + switched)
    assert searched(seen) == [0, 5]
    assert [one.tracks.ids.tolist() for one in seen] == [[1]] * 4 + [[]] + [[2]] * 7


def _wide(picture):
    wide = np.zeros((192, 960, 3), np.uint8)
    wide[:, :320] = picture
    return wide


@pytest.mark.parametrize(
    ("size", "fit", "source_of", "enlarged"),
    [
        ((640, 384), "letterbox", lambda picture: picture.repeat(2, axis=0).repeat(2, axis=1), False),
        # The edge would look at fewer pixels than the ground does, and its tracks would say less than the picture.
        ((160, 96), "letterbox", lambda picture: picture[::2, ::2], True),
        # The base shows the middle third: the ground would get stills of objects that its picture does not have.
        ((960, 192), "crop", _wide, False),
    ],
    ids=["larger", "smaller", "cropped"],
)
def test_candidates_of_the_source_lie_in_base_pixels(size, fit, source_of, enlarged):
    """Stills would be cut at the wrong place where the detector looks at the camera's own frame."""
    looked_at = []

    class Noting(RedSquares):
        def detect(self, image_bgr):
            looked_at.append(image_bgr)
            return super().detect(image_bgr)

    analyzer = make(
        detector=Noting(), view=View.fitted(size, SIZE, fit=fit), candidates="source", detect_every=1
    )
    frames = [replace(one, source_bgr=source_of(one.base_bgr)) for one in FRAMES[:4]]
    seen = analyzed(analyzer, frames)[-1]
    assert [one is frame.base_bgr for one, frame in zip(looked_at, frames, strict=True)] == [enlarged] * 4
    boxes = [] if fit == "crop" else [square_box(3)]
    np.testing.assert_allclose(seen.tracks.boxes_xyxy_px, np.reshape(boxes, (-1, 4)), atol=3)


def sparse(analyzer: Analyzer, *, every: int, hurried: frozenset[int] = frozenset()) -> list:
    # All frames, of which only each n-th is coded, as with ``--fps auto``.
    encoder = BaseEncoder(EncoderSettings(size=SIZE, fps=15, bitrate_bps=120_000, preset="ultrafast"))
    seen = []
    for frame in FRAMES:
        unit = encoder.encode(frame) if frame.index % every == 0 else None
        analyzer.cpu_budget.queued = 3 * (frame.index in hurried)
        seen.append(analyzer.analyze(replace(frame, source_bgr=frame.base_bgr), unit))
    return seen


@pytest.mark.parametrize(
    ("candidates", "every", "hurried", "detected"),
    [
        ("source", 1, (), [0, 5, 10, 15, 20, 25]),
        ("source", 2, (), [0, 6, 12, 18, 24]),
        ("source", 5, (), [0, 5, 10, 15, 20, 25]),
        ("source", 15, (), [0, 6, 11, 15, 20, 25]),
        ("source", 8, (), [0, 6, 8, 13, 16, 21, 24, 29]),
        ("decoded", 2, (), [0, 6, 12, 18, 24]),
        ("decoded", 8, (), [0, 8, 16, 24]),
        ("decoded", 15, (), [0, 15]),
        # With a slow detector and few coded frames, detection would be put off until the next coded one.
        ("source", 15, (15,), [0, 6, 11, 16, 21, 26]),
    ],
)
def test_where_few_ticks_are_coded_each_of_them_has_its_own_detection(candidates, every, hurried, detected):
    """Stills could not be cut where the base has no picture, or would be chosen by what was seen before it."""
    seen = sparse(make(candidates=candidates), every=every, hurried=frozenset(hurried))
    assert searched(seen) == detected
    assert [one.frame.index for one in seen if one.base_bgr is not None] == list(range(0, 30, every))
    for one in seen:
        assert one.tracks.frame_index == one.frame.index
    if every > 5 and not hurried:
        assert all(one.detected for one in seen if one.base_bgr is not None)


def test_ticks_that_are_not_coded_still_move_the_tracks():
    """At a frame a second, tracks would jump, and the tracks channel have nothing to say between."""
    seen = sparse(make(candidates="source", detect_every=3), every=10)
    for one in seen[7:]:
        assert one.tracks.ids.tolist() == [1]
        np.testing.assert_allclose(one.tracks.boxes_xyxy_px[0], square_box(one.frame.index), atol=6)


def test_with_candidates_of_the_source_the_camera_is_followed_on_the_source():
    """Tracks would be moved by what the coder left of the picture, and not at all between coded frames."""
    given: list[bool] = []

    class Watched(ByteTracker):
        def predict(self, *, frame_index, image=None):
            given.append(image is FRAMES[frame_index].base_bgr)
            return super().predict(frame_index=frame_index, image=image)

    for candidates, primary in (("source", True), ("decoded", False)):
        sparse(make(kind=Watched, camera_motion="flow", candidates=candidates), every=2)
        assert set(given) == {primary}
        given.clear()
