"""One frame of the side channel after the other: tracks, stills, and what the ground says of them."""

import threading
import time
from collections import Counter
from contextlib import closing, nullcontext
from dataclasses import replace

import cv2
import numpy as np
import pytest

from hvt_common.protocol.channels import Channel
from hvt_common.protocol.messages import StillResult
from hvt_common.runtime.failures import Failures
from hvt_common.tracking.bytetrack import ByteTracker
from hvt_common.tracking.settings import TrackerSettings
from hvt_common.units import SECOND_NS
from hvt_common.values import Frame, View
from hvt_common.video.base_crop import base_crop
from hvt_common.video.hevc import BaseDecoder, YuvPicture
from hvt_common.video.still_codecs import JpegCodec, StillCodec
from hvt_edge.link.pacer import Pacer
from hvt_edge.link.rate_control import RateController
from hvt_edge.operating import Keyframes
from hvt_edge.perception.analyzer import Analyzer
from hvt_edge.perception.frame_ring import FrameRing
from hvt_edge.stills.maker import StillMaker
from hvt_edge.stills.on_demand import OnDemandRequest
from hvt_edge.stills.requested_coding import RefusedError
from hvt_edge.stills.worker import StillWorker
from hvt_edge.video.x265 import BaseEncoder, EncoderSettings
from media.base_coded import StandIn
from media.clips import framed, smooth_pictures
from programs.processes import PATIENT_S, eventually
from rigs.flight import CLASSES, SIZE, RedSquares, square_box
from rigs.messages import RESULT
from rigs.world import Puts, make_still_stage, make_transmitter

VIEW = View.fitted(SIZE, SIZE, fit="letterbox")
_NOISE = np.random.default_rng(0).normal(0, 12, (SIZE[1], SIZE[0]))
_TEXTURE = 6 * cv2.GaussianBlur(_NOISE, (0, 0), 1.5)[..., None]
FRAMES = [
    replace(frame, source_bgr=np.clip(frame.base_bgr + _TEXTURE, 0, 255).astype(np.uint8))
    for frame in framed(smooth_pictures(30, size=SIZE))
]
_ENCODER = BaseEncoder(EncoderSettings(size=SIZE, fps=15, bitrate_bps=120_000, preset="ultrafast"))
UNITS = [_ENCODER.encode(frame) for frame in FRAMES]


def make_analyzer(candidates: str = "decoded", *, detector=None, every: int = 5) -> Analyzer:
    return Analyzer(
        detector or RedSquares(),
        ByteTracker(TrackerSettings.starting_at(0.25, camera_motion="off"), fps=15),
        view=VIEW,
        detect_every=every,
        candidates=candidates,
    )


class Rig:
    """A still stage whose stills build on the base, with a real budget of 200 kbps for them."""

    def __init__(
        self,
        *,
        reports: bool = False,
        sparse: bool = False,
        analyzer: Analyzer | None = None,
        codec: StillCodec | None = None,
        ring: FrameRing | None = None,
    ) -> None:
        self.out, self.outcomes, self.keyframes = Puts(), Counter(), Keyframes()
        self.sender = make_transmitter(self.out, budget=(400_000, 200_000))
        self.stage = make_still_stage(
            self.sender,
            analyzer or make_analyzer("source" if sparse else "decoded"),
            keyframes=self.keyframes,
            outcomes=self.outcomes,
            view=VIEW,
            class_names=CLASSES,
            maker=StillMaker(codec=codec or StandIn(), fallback=JpegCodec()),
            reporter=self if reports else None,
            ring=ring,
        )
        self.keyframes.done(FRAMES[0].capture_ns)

    def report(self, seen, *, now_ns) -> None:
        self.sender.metadata(Channel.TRACKS, lambda _at_ns: bytes([seen.frame.index]), now_ns=now_ns)

    def run(self, count: int = 30, *, start: int = 0) -> None:
        for frame, unit in list(zip(FRAMES, UNITS, strict=True))[start:count]:
            seen = self.stage.analyze(frame, unit)
            self.stage.step(seen, now_ns=frame.capture_ns)


def worker_of(
    rig: Rig, *, finish_s: float = PATIENT_S, clock=lambda: FRAMES[0].capture_ns, **more
) -> StillWorker:
    parts = {"failures": Failures(time.time_ns), **more}
    return StillWorker(rig.stage, results=list, clock=clock, finish_s=finish_s, **parts)


def decoded_bases() -> list[YuvPicture]:
    decoder = BaseDecoder()
    return [decoder.decode_yuv(unit.data) for unit in UNITS]


def answer(sequence: int, *, again: bool = True, class_name: str = "", track_id: int = 1) -> StillResult:
    return replace(RESULT, still_sequence=sequence, class_name=class_name, track_id=track_id, again=again)


def test_what_the_edge_builds_on_is_what_the_ground_decodes():
    """No still would ever fit the ground's pictures."""
    rig, bases = Rig(), decoded_bases()
    rig.run()
    assert [(header.sequence, header.frame_index) for header, _ in rig.out.stills] == [(0, 0), (1, 15)]
    assert rig.sender.ledger.outcomes("sent") == {"due": 2}
    assert rig.stage.analyzer.tracks == 1
    assert rig.stage.analyzer.mean_ms > 0
    for header, data in rig.out.stills:
        crop = header.crop_source_px
        size = (crop[2] - crop[0], crop[3] - crop[1])
        seen = base_crop(bases[header.frame_index], view=VIEW, crop_source_px=crop, size=size)
        shown = StandIn().decode(data, size=size, parameters=header.parameters, base_bgr=seen)
        source = FRAMES[header.frame_index].source_bgr[crop[1] : crop[3], crop[0] : crop[2]].astype(float)
        assert np.mean((shown - source) ** 2) < 0.8 * np.mean((seen - source) ** 2)
        np.testing.assert_allclose(header.box_source_px, square_box(header.frame_index), atol=6)


def test_a_still_that_the_ground_cannot_show_is_sent_again_from_the_same_frame():
    """A lost picture of the base would cost the stills on it as well."""
    rig = Rig()
    rig.run(4)
    rig.stage.on_results([answer(0), answer(0), answer(4_000_000)])
    rig.run(8, start=4)
    (first, _), (second, data) = rig.out.stills
    assert (first.codec, second.codec, second.reason) == ("stand-in", "jpeg", "again")
    assert (second.sequence, second.frame_index, second.parameters) == (1, 0, {"again": 0})
    crop = second.crop_source_px
    assert JpegCodec().decode(data, size=(crop[2] - crop[0], crop[3] - crop[1])) is not None
    rig.stage.on_results([answer(0), answer(1)])
    rig.run(12, start=8)
    assert len(rig.out.stills) == 2


def test_between_coded_ticks_tracks_go_on_and_stills_wait_for_a_coded_one():
    """With fewer coded pictures the edge would send stills that nobody can show, or none at all."""
    rig = Rig(sparse=True)
    encoder = BaseEncoder(EncoderSettings(size=SIZE, fps=1.5, bitrate_bps=120_000, preset="ultrafast"))
    for frame in FRAMES:
        unit = encoder.encode(frame) if frame.index % 10 == 3 else None
        seen = rig.stage.analyze(frame, unit)
        rig.stage.step(seen, now_ns=frame.capture_ns)
    headers = [header for header, _ in rig.out.stills]
    assert headers
    assert all(one.frame_index % 10 == 3 for one in headers)
    assert {one.codec for one in headers} == {"stand-in"}
    assert rig.stage.latest_tracks.frame_index == 29


def test_the_tracks_of_a_step_go_before_its_stills():
    """The ground would get stills of tracks that it has not heard of."""
    rig = Rig(reports=True)
    before = rig.stage.latest_tracks
    assert before is None
    rig.run(11)
    assert [row for row, *_ in rig.out.puts[:2]] == [Channel.TRACKS, Channel.ROI]
    assert [payload[0] for row, payload, *_ in rig.out.puts if row is Channel.TRACKS] == [0, 5, 10]
    assert rig.stage.latest_tracks.frame_index == 10


@pytest.mark.parametrize("coded_as_it_is", [False, True])
def test_frames_that_wait_are_bounded_in_bytes(coded_as_it_is):
    """A 4K camera and a slow detector would fill the drone's memory.

    A picture that is source and base is there once: counted twice, half as many waited, and a search of a third of a
    second left frames out.
    """
    counted = threading.Event()

    class Slow(RedSquares):
        def detect(self, image_bgr):
            assert counted.wait(60)
            return super().detect(image_bgr)

    frames = [replace(one, source_bgr=one.base_bgr) for one in FRAMES] if coded_as_it_is else FRAMES
    frame_bytes = FRAMES[0].base_bgr.nbytes + (0 if coded_as_it_is else FRAMES[0].source_bgr.nbytes)
    rig = Rig(analyzer=make_analyzer(detector=Slow(), every=1))
    worker = worker_of(rig, max_bytes=4 * frame_bytes + 1)
    worker.take(frames[0], UNITS[0])
    eventually(lambda: not worker.queued)
    offered = 1
    while not worker.full and offered < 16:
        worker.take(frames[offered], UNITS[offered])
        offered += 1
    counted.set()
    assert offered == 5, "four wait, and one is in hand"
    worker.close()
    roomy = worker_of(Rig(), max_bytes=1)
    assert not roomy.full
    roomy.take(FRAMES[0], UNITS[0])
    eventually(lambda: not roomy.queued)
    assert not roomy.full, "one frame always has its place"
    roomy.close()


class Blocking:
    """Somebody else's work that does not end before it is let go."""

    def __init__(self) -> None:
        self.began, self.released = threading.Event(), threading.Event()

    def __call__(self) -> None:
        self.began.set()
        assert self.released.wait(60)


def requested_beside(rig: Rig, blocking: Blocking) -> None:
    on_demand = rig.stage.chooser.on_demand
    assert on_demand is not None
    now_ns = FRAMES[0].capture_ns
    failures = Failures(time.time_ns)
    worker = worker_of(rig, failures=failures, clock=lambda: now_ns)

    def failing() -> list[str]:
        nonlocal now_ns
        now_ns += 11 * SECOND_NS
        return [one.part for one in failures.now]

    try:
        for frame, unit in zip(FRAMES[:16], UNITS, strict=False):
            eventually(lambda: worker.queued < 2 or blocking.began.is_set(), what="it is not hurried")
            if blocking.began.is_set():
                break
            worker.take(frame, unit)
        eventually(blocking.began.is_set, what="the other work has begun")
        before = len(rig.out.stills)
        worker.take(FRAMES[-1], None, late=True)
        _, frame_index = on_demand.request(OnDemandRequest(box_xywh_px=(40, 40, 96, 64)))
        assert frame_index == FRAMES[-1].index, "what the camera sees now, which nobody has analyzed"
        worker.serve_requested()
        eventually(lambda: len(rig.out.stills) > before, what="the requested still is there")
        assert not blocking.released.is_set()
        eventually(lambda: failing() == ["stills"], what="it is said that they hang")
        assert rig.out.stills[-1][0].reason == "asked"
    finally:
        blocking.released.set()
        worker.close()


def test_a_requested_still_goes_out_while_a_detection_takes_its_time():
    """Whoever looks closer would wait for the detector of a slow board: 4.9 s where there is room for it at once."""
    blocking = Blocking()

    class Slow(RedSquares):
        detections = 0

        def detect(self, image_bgr):
            self.detections += 1
            if self.detections > 1:
                blocking()
            return super().detect(image_bgr)

    requested_beside(Rig(analyzer=make_analyzer(detector=Slow()), ring=FrameRing()), blocking)


def test_a_requested_still_is_given_up_in_time_though_a_keyframe_goes_first_and_never_goes():
    """Its requester would wait, and be told of nothing, where the ground had just left."""
    rig = Rig(ring=FrameRing())
    on_demand, now_ns = rig.stage.chooser.on_demand, FRAMES[0].capture_ns
    assert on_demand is not None
    rig.stage.capture(FRAMES[0])
    boxes = (40, 40, 96, 64), (40, 40, 64, 96)
    number, behind = (on_demand.request(OnDemandRequest(box_xywh_px=box))[0] for box in boxes)
    rig.keyframes.require(now_ns)
    for second in range(12):
        assert not rig.stage.send_requested(now_ns=now_ns + second * SECOND_NS)
    with pytest.raises(RefusedError, match="in 10 s the keyframe that goes before it had no room"):
        on_demand.outcome(number)
    with pytest.raises(RefusedError, match="in 10 s those that were requested before it had not gone"):
        on_demand.outcome(behind)


@pytest.mark.parametrize("offline", [True, False], ids=["stored", "sent"])
def test_where_nobody_takes_the_video_a_request_is_refused_if_stills_are_stored(offline):
    """It was accepted and kept. But one who reads stills alone, of an edge that stores nothing, has it at once."""
    rig = Rig(ring=FrameRing())
    rig.sender.pacer = Pacer(RateController(ceiling_bps=400_000, floor_bps=100_000))
    rig.sender.pacer.link(there=False, now_ns=FRAMES[0].capture_ns)
    on_demand = rig.stage.chooser.on_demand
    assert on_demand is not None
    on_demand.offline = lambda: offline
    rig.stage.capture(FRAMES[0])
    with pytest.raises(RefusedError, match="stills are stored") if offline else nullcontext():
        on_demand.request(OnDemandRequest(box_xywh_px=(40, 40, 96, 64)))


def test_a_requested_still_goes_out_while_an_automatic_one_is_coded_and_numbers_go_up():
    """It would wait for what nobody asked for; or two stills would have one number, and one of them be lost."""
    blocking = Blocking()

    class Slow(StandIn):
        def encode(self, crop_bgr, *, quality_pct, base_bgr=None):
            if not blocking.released.is_set():
                blocking()
            return super().encode(crop_bgr, quality_pct=quality_pct, base_bgr=base_bgr)

    rig = Rig(codec=Slow(), ring=FrameRing())
    requested_beside(rig, blocking)
    headers = [header for header, _ in rig.out.stills]
    assert [one.sequence for one in headers] == list(range(len(headers)))
    assert [one.reason == "asked" for one in headers[:2]] == [True, False]


def test_a_pending_still_holds_no_frame():
    """Eight of them would hold eight frames of a 4K camera: 200 MB."""
    import gc
    import weakref

    class Tracked(np.ndarray):
        """An array that may be watched."""

    rig = Rig()
    source = FRAMES[0].source_bgr.copy().view(Tracked)
    watch = weakref.ref(source)
    frame = Frame(0, FRAMES[0].capture_ns, source, FRAMES[0].base_bgr)
    seen = rig.stage.analyze(frame, UNITS[0])
    rig.stage.step(seen, now_ns=frame.capture_ns, held=True)
    assert len(rig.stage.outbox) == 1
    del source, frame, seen
    gc.collect()
    assert watch() is None
    assert len(rig.stage.outbox) == 1


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

    def known() -> str | None:
        (candidate,) = rig.stage.chooser.memory.candidates(
            rig.stage.latest_tracks, view=VIEW, class_names=CLASSES, now_ns=FRAMES[5].capture_ns
        )
        return candidate.posterior and candidate.posterior.class_name

    rig.stage.on_results([answer(0, again=False)])
    assert known() is None
    rig.stage.on_results([answer(0, again=False, class_name="bus", track_id=one) for one in (1, 99)])
    assert known() == "bus"


def test_the_worker_takes_all_frames_in_order_and_finishes():
    """The last stills of a clip would be missing."""
    rig = Rig()
    with closing(worker_of(rig)) as worker:
        for frame, unit in zip(FRAMES, UNITS, strict=True):
            eventually(lambda: worker.queued < 2, what="it is not hurried")
            worker.take(frame, unit)
    assert rig.stage.analyzer.frames == 30
    assert [one.frame_index for one, _ in rig.out.stills] == [0, 15]


def test_a_pending_still_leaves_without_another_frame():
    """At one frame a second each still would wait for the next, and there find the link busy with it."""
    rig = Rig()
    rig.keyframes.require(FRAMES[0].capture_ns)
    rig.run(1)
    assert (len(rig.stage.outbox), rig.out.stills) == (1, []), "a keyframe goes first"
    rig.keyframes.done(FRAMES[0].capture_ns)
    with closing(worker_of(rig)):
        eventually(lambda: rig.out.stills, what="the still has left")


def test_stills_that_fail_stop_alone_and_go_on_from_a_keyframe(caplog):
    """A single bad picture would end the flight's video; or the edge look alive and never send a still again."""
    broken = threading.Event()
    broken.set()

    class Broken(RedSquares):
        def detect(self, image_bgr):
            if broken.is_set():
                raise RuntimeError("no memory")
            return super().detect(image_bgr)

    failures, now_ns = Failures(time.time_ns), FRAMES[0].capture_ns
    rig = Rig(analyzer=make_analyzer(detector=Broken()))
    with closing(worker_of(rig, failures=failures, clock=lambda: now_ns)) as worker:
        worker.take(FRAMES[0], UNITS[0])
        eventually(lambda: failures.parts, what="the failure is noticed")
        assert not worker.take(FRAMES[1], UNITS[1]), "nothing is analyzed for a while"
        broken.clear()
        now_ns += 60 * SECOND_NS
        assert not worker.full, "the pause is over"
        assert worker.take(FRAMES[2], UNITS[2]), "and is not decoded: units before it are missing"
        encoder = BaseEncoder(EncoderSettings(size=SIZE, fps=15, bitrate_bps=120_000, preset="ultrafast"))
        for frame in FRAMES[3:20]:
            eventually(lambda: worker.queued < 2, what="it is not hurried")
            worker.take(frame, encoder.encode(frame, keyframe=frame.index == 3))
    (failed,) = failures.parts
    assert (failed.part, failed.count, failed.working) == ("stills", 1, True)
    assert rig.stage.analyzer.tracks == 1, "what is there is tracked again"
    assert [one.message.split(";")[0] for one in caplog.records] == [
        "stills: perception and stills stopped (RuntimeError: no memory)",
        "stills: works again",
    ]


def test_closing_a_busy_worker_is_quick_and_leaves_nothing_running():
    """Ctrl-C would hang behind a slow detector, or two threads would use one queue."""
    rig = Rig(analyzer=make_analyzer(detector=RedSquares(takes_s=0.5)))
    before = set(threading.enumerate())
    worker = worker_of(rig, finish_s=0.2)
    running = set(threading.enumerate()) - before
    assert {one.name for one in running} == {"hvt-stills"}
    for frame, unit in zip(FRAMES[:16], UNITS, strict=False):
        worker.take(frame, unit)
    worker.close()
    for thread in running:
        thread.join(timeout=60)
    assert running.isdisjoint(threading.enumerate())
    assert rig.stage.analyzer.frames < 16, "what was not in hand was left"
