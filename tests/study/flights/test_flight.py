"""A whole flight in one process, on small drawn pictures with a detector of red things."""

from unittest.mock import MagicMock

import numpy as np
import pytest

from hvt_study.flights.flight import Flight, coded_frames, fly
from hvt_study.flights.flight_ground import SharedModels
from hvt_study.reading.flight import _ReadGround
from media.clips import smooth_pictures
from rigs.flight import SIZE, RedSquares, grainy_pictures, square_box
from studies.metric_frames import clip_of, flight_plan, list_f1

FRAMES = 46
STILLS = ("--method", "M5", "--cooldown", "0s", "--budget", "120kbps", "--still-codec", "residual")


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """A red square that moves seven pixels a frame over a smooth ground, and jumps back once."""
    return clip_of(smooth_pictures(FRAMES, size=SIZE), tmp_path_factory.mktemp("clip"))


@pytest.fixture(scope="module")
def rough_clip(tmp_path_factory):
    """The same with a grain on the square."""
    return clip_of(grainy_pictures(FRAMES), tmp_path_factory.mktemp("rough"))


def flown(clip, *flags, link_bps=200_000, detector=None, ground_detector=None):
    plan = flight_plan(clip, *flags, link_bps=link_bps)
    return fly(plan, detector=detector or RedSquares(), models=SharedModels(ground_detector or RedSquares()))


def f1_of(report, frames):
    return list_f1(report, frames, lambda frame_index: ([square_box(frame_index)], ("car",)))


def test_video_alone_shows_the_square_at_every_frame(clip):
    """The list at the ground, its bits and its delay are what every table of the comparison is made of."""
    report = flown(clip, "--method", "M0")
    assert len(report.lists) == FRAMES
    assert f1_of(report, range(FRAMES)) > 0.9
    assert report.messages["base"] == FRAMES
    assert report.messages.get("roi", 0) == 0
    # What was put on the link is what the edge's own ledger says.
    assert report.bps() == report.account.total_bps
    assert report.bps("base") == report.account.base_bps
    assert 0 < report.link.delay_p50_ms <= report.link.delay_p95_ms < 1000
    assert 0 < report.max_frame_bytes < report.line_bytes["base"]
    assert report.edge_cpu_ms > 0


AUTO = (
    *("--method", "M6", "--candidates", "source", "--send-tracks", "--profile", "auto"),
    *("--video-share", "auto", "--detect-every", "5"),  # as studies say it
)


@pytest.mark.parametrize(
    "flags", [pytest.param(("--method", "M5"), marks=pytest.mark.nightly), AUTO], ids=["M5", "auto"]
)
def test_the_same_flight_twice(clip, flags):
    """A table that changes from run to run proves nothing."""
    first, second = flown(clip, *flags), flown(clip, *flags)
    assert first.digest == second.digest
    assert first.messages == second.messages
    assert first.link == second.link
    for one, other in zip(first.lists, second.lists, strict=True):
        assert one.class_names == other.class_names
        assert np.array_equal(one.boxes_xyxy_px, other.boxes_xyxy_px)


def test_frames_between_coded_ones_are_predicted(clip):
    """Judged on coded frames only, a slow base stream would look as good as a fast one."""
    report = flown(clip, "--method", "M0", "--fps", "5")
    coded = coded_frames(FRAMES, 5)
    assert report.messages["base"] == len(coded) == 16
    between = [frame_index for frame_index in range(9, 40) if frame_index not in coded]  # at 40 it jumps back
    boxes = [report.lists[frame_index].boxes_xyxy_px for frame_index in between]
    assert all(len(one) for one in boxes)
    # The square moves on between them: a list that was merely repeated would be 7 and 14 pixels behind.
    assert f1_of(report, between) > 0.8


def test_a_thin_link_delivers_late(clip):
    """Delay is what a smaller budget costs the operator first."""
    wide, thin = (flown(clip, "--method", "M0", link_bps=rate) for rate in (400_000, 100_000))
    assert wide.digest == thin.digest  # nothing at the edge hangs on the link here
    assert thin.link.delay_p95_ms > 2 * wide.link.delay_p95_ms
    assert thin.picture_age_p95_ms > wide.picture_age_p95_ms
    assert thin.link.worst_queue_bytes > wide.link.worst_queue_bytes


def test_who_reads_a_flight_sees_all_of_it_and_changes_nothing(rough_clip):
    """`hvt-study read` would end in a traceback, or tell of another flight than the one that is compared."""
    plan, observer = flight_plan(rough_clip, *STILLS), MagicMock()
    parts = {"config": plan.ground, "models": SharedModels(RedSquares()), "observer": observer}
    flight = Flight(
        plan, detector=RedSquares(), make_ground=lambda info, link: _ReadGround(info, link=link, **parts)
    )
    flight.run()
    report = flight.report(saved_cpu_s=0)
    assert report.digest == flown(rough_clip, *STILLS).digest
    assert observer.picture.call_count == report.messages["base"]
    stills = [still for call in observer.stills.call_args_list for still in call.args[0]]
    assert len(stills) == report.messages["roi"] > 0


def test_tracks_are_sent_while_the_base_hides_what_they_tell(clip):
    """On a large object that any video shows, tracks and their bits are wasted; where it is hidden they are all."""

    class Blind(RedSquares):
        """Sees the square on untouched pixels only: coded ones are never exactly as red."""

        def detect(self, image_bgr):
            untouched = (image_bgr == np.array([30, 60, 230], np.uint8)).all(axis=2).sum() > 500
            return super().detect(image_bgr if untouched else np.zeros_like(image_bgr))

    shown = flown(clip, *AUTO)
    assert shown.messages.get("tracks", 0) <= 2
    hidden = flown(clip, *AUTO, detector=Blind(), ground_detector=Blind())
    assert hidden.messages["tracks"] >= 5
    assert hidden.account.total_bps <= 200_000
    # The ground's own detector sees it all the same, and says so: after a second no more are sent.
    assert flown(clip, *AUTO, detector=Blind()).messages["tracks"] < hidden.messages["tracks"]


def test_a_ground_that_sees_nothing_is_sent_tracks(clip):
    """The edge's own detector finds all on its base: without the ground's word it would never send any."""

    class Nothing(RedSquares):
        """As where the model of the ground knows other objects."""

        def detect(self, image_bgr):
            return super().detect(np.zeros_like(image_bgr))

    report = flown(clip, *AUTO, ground_detector=Nothing())
    assert report.messages["tracks"] >= 3
    # The first second of its reports does not count; then the next comparison decides.
    listed = [list(report.lists[frame].class_names) for frame in range(40)]
    assert listed[:16] == [[]] * 16
    assert listed[34:] == [["car"]] * 6
    assert report.account.total_bps <= 200_000


def test_coded_frames():
    """Two frames a second of fifteen frames: every seventh or eighth, never two for one instant."""
    assert sorted(coded_frames(31, 2)) == [0, 8, 15, 23, 30]
    assert coded_frames(10, 15) == frozenset(range(10))
    assert sorted(coded_frames(10, 7.5)) == [0, 2, 4, 6, 8]
    assert coded_frames(1, 1) == {0}
