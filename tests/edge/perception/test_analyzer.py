"""What the edge sees of its own stream, and the thread it sees in."""

from __future__ import annotations

import threading
import time
from collections import Counter
from contextlib import closing
from dataclasses import replace
from itertools import count

import cv2
import numpy as np
import pytest

from hvt_common.inference.scale_search import ScaleSearch
from hvt_common.inference.view_trust import ViewTrust
from hvt_common.protocol.ledger import Ledger
from hvt_common.runtime.failures import Failures
from hvt_common.tracking.bytetrack import ByteTracker
from hvt_common.tracking.settings import TrackerSettings
from hvt_common.units import SECOND_NS
from hvt_common.values import Frame, View
from hvt_common.video.hevc import YuvPicture
from hvt_edge.config import EdgeConfig, check
from hvt_edge.operating import Keyframes
from hvt_edge.perception.analyzer import Analyzer
from hvt_edge.perception.candidates import TrackMemory
from hvt_edge.perception.cpu_budget import CpuBudget
from hvt_edge.stills.worker import StillWorker
from hvt_edge.video.x265 import BaseEncoder, EncoderSettings
from hvt_edge.wiring.perception import make_analyzer
from media.clips import framed, smooth_pictures
from programs.processes import PATIENT_S, eventually
from rigs.flight import CLASSES, SIZE, NothingSeen, RedSquares, square_box
from rigs.messages import RESULT
from rigs.world import Puts, make_still_stage, make_transmitter

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


def make(*, detector=None, view: View = VIEW, search: ScaleSearch | None = None, **settings) -> Analyzer:
    """The edge's analyzer."""
    tracker = ByteTracker(TrackerSettings.starting_at(0.25, camera_motion="off"), fps=15)
    return Analyzer(detector or RedSquares(), tracker, view=view, **settings, search=search)


def test_every_frame_is_decoded_and_each_nth_is_searched():
    """Candidates would be of other frames than the stills, or the processor would melt."""
    trust, taken = ViewTrust(None, hence=""), []
    trust.take = lambda found: taken.append(len(found))
    analyzer = make(detect_every=5, trust=trust)
    seen = [analyzer.analyze(frame, unit) for frame, unit in zip(FRAMES, UNITS, strict=True)]
    assert [one.frame.index for one in seen if one.detected] == [0, 5, 10, 15, 20, 25]
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
    seen = [analyzer.analyze(frame, unit) for frame, unit in zip(FRAMES, UNITS, strict=True)]
    assert [one.frame.index for one in seen if one.detected] == [0, 9, 18, 21, 24, 27], "in vain at last"
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
    for frame, unit in zip(FRAMES[:6], UNITS, strict=False):
        analyzer.analyze(frame, unit)
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
    for frame, unit in zip(FRAMES, UNITS, strict=True):
        analyzer.analyze(frame, unit)
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
    tracker = ByteTracker(TrackerSettings.starting_at(0.25, camera_motion="flow"), fps=15)
    analyzer = Analyzer(RedSquares(), tracker, view=VIEW, detect_every=5, candidates=candidates)
    found = 0
    for frame, unit in zip(FRAMES, UNITS, strict=True):
        seen = analyzer.analyze(frame, unit)
        if seen.detected:
            found += 1
            assert seen.base_bgr is seen.base_bgr, "once"
        assert seen.base is not None
    assert len(converted) == found == 6


def test_in_a_hurry_detection_is_put_off_and_made_up_for():
    """A slow detector would fall behind more and more; or a busy second would leave it blind for another."""
    analyzer = make(detect_every=5)
    hurried = {5, 6, 7, 15}
    seen = []
    for frame, unit in zip(FRAMES, UNITS, strict=True):
        analyzer.cpu_budget.queued = 3 * (frame.index in hurried)
        seen.append(analyzer.analyze(frame, unit))
    assert [one.frame.index for one in seen if one.detected] == [0, 8, 13, 18, 23, 28]
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
    tracker = ByteTracker(TrackerSettings.starting_at(0.25, camera_motion="flow"), fps=15)
    rates = {"detect_every": 5, "detect_still_every": 15}
    analyzer = Analyzer(RedSquares(), tracker, view=VIEW, candidates="source", **rates)
    standing = [replace(FRAMES[0], index=index) for index in range(20)]
    seen = [analyzer.analyze(frame, unit) for frame, unit in zip(standing + FRAMES[20:], UNITS, strict=True)]
    assert [one.frame.index for one in seen if one.detected] == [0, 15, 25]


def test_another_scene_is_searched_at_once():
    """Boxes of the scene before, and its tracks, went to the ground until the next look was due."""
    tracker = ByteTracker(TrackerSettings.starting_at(0.25, camera_motion="flow"), fps=15)
    analyzer = Analyzer(RedSquares(), tracker, view=VIEW, detect_every=8, candidates="source")
    other = np.random.default_rng(2).integers(0, 2, (6, 10, 3), np.uint8) * 200
    other = cv2.resize(other, SIZE, interpolation=cv2.INTER_CUBIC)
    other[100:132, 50:82] = (20, 20, 220)
    switched = [replace(frame, source_bgr=other, base_bgr=other) for frame in FRAMES[4:12]]
    frames = zip(FRAMES[:4] + switched, UNITS, strict=False)
    seen = [analyzer.analyze(frame, unit) for frame, unit in frames]
    assert [one.frame.index for one in seen if one.detected] == [0, 5]
    assert [one.tracks.ids.tolist() for one in seen] == [[1]] * 4 + [[]] + [[2]] * 7


def test_candidates_of_the_source_lie_in_base_pixels():
    """Stills would be cut at the wrong place where the detector looks at the camera's own frame."""
    view = View.fitted((640, 384), SIZE, fit="letterbox")
    analyzer = make(view=view, candidates="source", detect_every=1)
    for frame, unit in zip(FRAMES[:4], UNITS, strict=False):
        large = np.repeat(np.repeat(frame.base_bgr, 2, axis=0), 2, axis=1)
        seen = analyzer.analyze(Frame(frame.index, frame.capture_ns, large, frame.base_bgr), unit)
    np.testing.assert_allclose(seen.tracks.boxes_xyxy_px[0], square_box(3), atol=3)


def test_a_source_smaller_than_the_base_is_looked_at_enlarged():
    """The edge would look at fewer pixels than the ground does, and its tracks would say less than the picture."""
    looked_at = []

    class Noting(RedSquares):
        def detect(self, picture_bgr):
            looked_at.append(picture_bgr)
            return super().detect(picture_bgr)

    view = View.fitted((160, 96), SIZE, fit="letterbox")
    analyzer = make(detector=Noting(), view=view, candidates="source", detect_every=1)
    for frame, unit in zip(FRAMES[:4], UNITS, strict=False):
        small = frame.base_bgr[::2, ::2]
        seen = analyzer.analyze(Frame(frame.index, frame.capture_ns, small, frame.base_bgr), unit)
    assert all(picture is frame.base_bgr for picture, frame in zip(looked_at, FRAMES, strict=False))
    np.testing.assert_allclose(seen.tracks.boxes_xyxy_px[0], square_box(3), atol=3)


def test_what_a_cropped_base_does_not_show_is_no_candidate():
    """The ground would get stills of objects that its picture does not have."""
    view = View.fitted((960, 192), SIZE, fit="crop")  # the base shows the middle third
    analyzer = make(view=view, candidates="source", detect_every=1)
    for frame, unit in zip(FRAMES[:3], UNITS, strict=False):
        wide = np.zeros((192, 960, 3), np.uint8)
        wide[:, :320] = frame.base_bgr
        seen = analyzer.analyze(Frame(frame.index, frame.capture_ns, wide, frame.base_bgr), unit)
    assert len(seen.tracks) == 0


def sparse(analyzer: Analyzer, *, every: int, hurried: frozenset[int] = frozenset()) -> list:
    """All frames, of which only each n-th is coded, as with ``--fps auto``."""
    encoder = BaseEncoder(EncoderSettings(size=SIZE, fps=15, bitrate_bps=120_000, preset="ultrafast"))
    seen = []
    for frame in FRAMES:
        unit = encoder.encode(frame) if frame.index % every == 0 else None
        analyzer.cpu_budget.queued = 3 * (frame.index in hurried)
        seen.append(analyzer.analyze(replace(frame, source_bgr=frame.base_bgr), unit))
    return seen


@pytest.mark.parametrize(
    ("candidates", "every", "detected"),
    [
        ("source", 1, [0, 5, 10, 15, 20, 25]),
        ("source", 2, [0, 6, 12, 18, 24]),
        ("source", 5, [0, 5, 10, 15, 20, 25]),
        ("source", 15, [0, 6, 11, 15, 20, 25]),
        ("source", 8, [0, 6, 8, 13, 16, 21, 24, 29]),
        ("decoded", 2, [0, 6, 12, 18, 24]),
        ("decoded", 8, [0, 8, 16, 24]),
        ("decoded", 15, [0, 15]),
    ],
)
def test_where_few_ticks_are_coded_each_of_them_has_its_own_detection(candidates, every, detected):
    """Stills could not be cut where the base has no picture, or would be chosen by what was seen before it."""
    seen = sparse(make(candidates=candidates), every=every)
    assert [one.frame.index for one in seen if one.detected] == detected
    assert [one.frame.index for one in seen if one.base_bgr is not None] == list(range(0, 30, every))
    for one in seen:
        assert one.tracks.frame_index == one.frame.index
    if every > 5:
        assert all(one.detected for one in seen if one.base_bgr is not None)


def test_ticks_that_are_not_coded_still_move_the_tracks():
    """At a frame a second, tracks would jump, and the tracks channel have nothing to say between."""
    seen = sparse(make(candidates="source", detect_every=3), every=10)
    for one in seen[7:]:
        assert one.tracks.ids.tolist() == [1]
        np.testing.assert_allclose(one.tracks.boxes_xyxy_px[0], square_box(one.frame.index), atol=6)


def test_a_hurried_coded_tick_is_made_up_for():
    """With a slow detector and few coded frames, detection would be put off until the next coded one."""
    seen = sparse(make(candidates="source"), every=15, hurried=frozenset({15}))
    assert [one.frame.index for one in seen if one.detected] == [0, 6, 11, 16, 21, 26]


def test_with_candidates_of_the_source_the_camera_is_followed_on_the_source():
    """Tracks would be moved by what the coder left of the picture, and not at all between coded frames."""
    given: list[bool] = []

    class Watched(ByteTracker):
        def predict(self, *, frame_index, image=None):
            given.append(image is FRAMES[frame_index].base_bgr)
            return super().predict(frame_index=frame_index, image=image)

    for candidates, primary in (("source", True), ("decoded", False)):
        tracker = Watched(TrackerSettings.starting_at(0.25, camera_motion="flow"), fps=15)
        sparse(Analyzer(RedSquares(), tracker, view=VIEW, candidates=candidates), every=2)
        assert set(given) == {primary}
        given.clear()


class Rig:
    """A still stage with a real budget of 200 kbps for stills, and all that left it."""

    def __init__(self, *, detector=None) -> None:
        self.out, self.outcomes = Puts(), Counter()
        self.memory, self.keyframes, self.ledger = TrackMemory(), Keyframes(), Ledger()
        sender = make_transmitter(self.out, budget=(400_000, 200_000), ledger=self.ledger)
        self.stage = make_still_stage(
            sender,
            make(detector=detector),
            keyframes=self.keyframes,
            outcomes=self.outcomes,
            view=VIEW,
            class_names=CLASSES,
            memory=self.memory,
        )
        self.keyframes.done(FRAMES[0].capture_ns)

    def class_of_track(self) -> str | None:
        """What is remembered that a ground made of the only track."""
        tracks = self.stage.latest_tracks
        assert tracks is not None
        (candidate,) = self.memory.candidates(
            tracks, view=VIEW, class_names=CLASSES, now_ns=FRAMES[5].capture_ns
        )
        return None if candidate.posterior is None else candidate.posterior.class_name

    def run(self, count: int = 30) -> None:
        """Frame after frame, as the lockstep loop does."""
        for frame, unit in zip(FRAMES[:count], UNITS, strict=False):
            self.stage.step(self.stage.analyze(frame, unit), now_ns=frame.capture_ns)


def test_a_track_gets_its_stills_when_they_are_due():
    """M1 would send nothing, or stills of the wrong moment."""
    rig = Rig()
    rig.run()
    assert [one.sequence for one, _ in rig.out.stills] == list(range(len(rig.out.stills)))
    assert [one.frame_index for one, _ in rig.out.stills] == [0, 15]
    for one, _ in rig.out.stills:
        np.testing.assert_allclose(one.box_source_px, square_box(one.frame_index), atol=6)
    assert rig.ledger.outcomes("sent") == {"due": len(rig.out.stills)}
    assert rig.stage.analyzer.tracks == 1
    assert rig.stage.analyzer.mean_ms > 0


def test_while_a_keyframe_is_due_stills_are_held():
    """A still would take the room that the keyframe waits for."""
    rig = Rig()
    assert rig.keyframes.request(FRAMES[0].capture_ns + 500_000_000) is None
    rig.run()
    assert rig.out.stills == []
    rig.keyframes.done(FRAMES[-1].capture_ns)
    assert len(rig.stage.outbox) == 1
    rig.stage.chooser.close()
    assert rig.outcomes["dropped", "ended"] == 1


def test_what_the_ground_says_counts_and_no_opinion_does_not():
    """M3 and M5 would never learn what the classifier sees."""
    rig = Rig()
    rig.run(6)
    answer = replace(RESULT, still_sequence=0, track_id=1)
    rig.stage.on_results([replace(answer, class_name="")])
    assert rig.class_of_track() is None
    bus = replace(answer, class_name="bus")
    rig.stage.on_results([bus, replace(bus, track_id=99)])
    assert rig.class_of_track() == "bus"


def test_the_worker_takes_all_frames_in_order_and_finishes():
    """The last stills of a clip would be missing."""
    rig = Rig()
    with closing(
        StillWorker(
            rig.stage,
            results=list,
            failures=Failures(time.time_ns),
            clock=lambda: FRAMES[0].capture_ns,
            finish_s=PATIENT_S,
        )
    ) as worker:
        for frame, unit in zip(FRAMES, UNITS, strict=True):
            eventually(lambda: worker.queued < 2, what="it is not hurried")
            worker.take(frame, unit)
    assert rig.stage.analyzer.frames == 30
    assert [one.frame_index for one, _ in rig.out.stills] == [0, 15]


def test_stills_that_fail_stop_alone_and_go_on_from_a_keyframe(caplog):
    """A single bad picture would end the flight's video; or the edge look alive and never send a still again."""
    broken = threading.Event()
    broken.set()

    class Broken(RedSquares):
        def detect(self, image_bgr):
            if broken.is_set():
                raise RuntimeError("no memory")
            return super().detect(image_bgr)

    rig, failures, now_ns = Rig(detector=Broken()), Failures(time.time_ns), FRAMES[0].capture_ns
    with closing(
        StillWorker(rig.stage, results=list, failures=failures, clock=lambda: now_ns, finish_s=PATIENT_S)
    ) as worker:
        worker.take(FRAMES[0], UNITS[0])
        eventually(lambda: failures.parts, what="the failure is noticed")
        assert not worker.take(FRAMES[1], UNITS[1]), "nothing is analyzed for a while"
        broken.clear()
        now_ns += 60 * SECOND_NS
        assert not worker.full, "the pause is over"
        assert worker.take(FRAMES[2], UNITS[2]), "and is not decoded: units before it are missing"
        again = [replace(unit, keyframe=index == 3) for index, unit in enumerate(UNITS)]
        encoder = BaseEncoder(EncoderSettings(size=SIZE, fps=15, bitrate_bps=120_000, preset="ultrafast"))
        again[3:20] = [encoder.encode(frame, keyframe=frame.index == 3) for frame in FRAMES[3:20]]
        for index in range(3, 20):
            eventually(lambda: worker.queued < 2, what="it is not hurried")
            worker.take(FRAMES[index], again[index])
    (failed,) = failures.parts
    assert (failed.part, failed.count, failed.working) == ("stills", 1, True)
    assert rig.stage.analyzer.tracks == 1, "what is there is tracked again"
    assert [one.message.split(";")[0] for one in caplog.records] == [
        "stills: perception and stills stopped (RuntimeError: no memory)",
        "stills: works again",
    ]


def test_closing_a_busy_worker_is_quick_and_leaves_nothing_running():
    """Ctrl-C would hang behind a slow detector, or two threads would use one queue."""
    rig = Rig(detector=RedSquares(takes_s=0.5))
    before = set(threading.enumerate())
    worker = StillWorker(
        rig.stage,
        results=list,
        failures=Failures(time.time_ns),
        clock=lambda: FRAMES[0].capture_ns,
        finish_s=0.2,
    )
    running = set(threading.enumerate()) - before
    assert {one.name for one in running} == {"hvt-stills"}
    for frame, unit in zip(FRAMES[:16], UNITS, strict=False):
        worker.take(frame, unit)
    worker.close()
    assert rig.stage.analyzer.frames < 16, "what was not in hand was left"
    for thread in running:
        thread.join(timeout=60)
    assert running.isdisjoint(threading.enumerate())
    assert rig.stage.analyzer.frames < 16
