"""The two-pass peer from camera to list, on small drawn pictures with a detector of red things."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from hvt_common.errors import UserError
from hvt_common.values import Detections
from hvt_study.metrics.observed import detected_frames
from hvt_study.peers.dds import DdsSettings, fly_dds
from media.clips import hard_pictures, smooth_pictures
from rigs.flight import CLASSES, SIZE, RedSquares, square_box
from studies.metric_frames import clip_of, list_f1

FRAMES = 46
BUDGET_BPS = 200_000
QUICK = DdsSettings(high=0.5, preset="ultrafast", request_bytes=200, bundle_bytes=1000, camera_motion="off")
DIM_AT = (200, 20, 232, 52)
"""Where a second square stands, too dim for the first pass."""


class Doubtful:
    """Red squares of full saturation for sure; dimmer ones with the confidence that their sharpness allows."""

    class_names = CLASSES

    def __init__(self, *, moving=0.9, sharp=0.8, blurred=0.3):
        self.moving, self.sharp, self.blurred = moving, sharp, blurred
        self.asked = 0

    def detect(self, image_bgr):
        """The moving one, and the one at `DIM_AT`: how much of its fine pattern is left says how sure it is."""
        self.asked += 1
        found = RedSquares().detect(image_bgr[SIZE[1] // 3 - 4 : SIZE[1] // 3 + 40])
        rows = [(*(found.boxes_xyxy_px[0] + [0, SIZE[1] // 3 - 4] * 2), self.moving, 0)] if len(found) else []
        x1, y1, x2, y2 = DIM_AT
        patch = image_bgr[y1:y2, x1:x2].astype(np.float32).mean(axis=2)
        contrast = float(patch.std())
        if contrast > 12:
            rows.append((*DIM_AT, self.sharp if contrast > 38 else self.blurred, 1))
        table = np.array(rows, np.float32).reshape(-1, 6)
        return Detections(table[:, :4], table[:, 4], table[:, 5].astype(np.int32))


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """A red square that moves over a smooth ground, and a checked one that stands still."""
    pictures = smooth_pictures(FRAMES, size=SIZE)
    x1, y1, x2, y2 = DIM_AT
    rows, columns = np.indices((y2 - y1, x2 - x1))
    checks = ((rows + columns) % 4 // 2 * 100 + columns // 16 * 40 + 40).astype(np.uint8)
    for picture in pictures:
        picture[y1:y2, x1:x2] = checks[..., None]
    return clip_of(pictures, tmp_path_factory.mktemp("clip"))


def f1_of(report, frames):
    """Of the list, against where square and checks really are."""
    return list_f1(report, frames, lambda frame_index: ([square_box(frame_index), DIM_AT], ("car", "bus")))


def flown(clip, *, detector=None, budget_bps=BUDGET_BPS, link_bps=None, **changes):
    return fly_dds(
        clip,
        budget_bps=budget_bps,
        link_bps=link_bps or budget_bps,
        size=SIZE,
        detector=detector or Doubtful(),
        settings=replace(QUICK, **changes),
    )


@pytest.fixture(scope="module")
def report(clip):
    """One flight that most tests look at; its first pass is small, so that the checks are lost in it."""
    return flown(clip, scale=0.3)


def test_what_only_the_second_pass_shows_is_found(clip, report):
    """That is the whole idea of the peer; without it, it is video at half the budget."""
    assert len(report.lists) == FRAMES
    assert all("bus" in report.lists[frame_index].class_names for frame_index in range(2, FRAMES))
    row = report.lists[20].class_names.index("bus")
    assert report.lists[20].confidences[row] == pytest.approx(0.8)
    assert f1_of(report, range(2, 40)) > 0.9
    # The first pass alone had 0.3 for it.
    alone = flown(clip, scale=0.3, high=0.3)
    assert alone.messages.get("roi", 0) == 0
    assert alone.lists[20].confidences[alone.lists[20].class_names.index("bus")] == pytest.approx(0.3)


def test_every_byte_of_both_passes_counts_once(report):
    """A peer whose second pass came for free would beat everybody."""
    assert set(report.line_bytes) == {"base", "roi", "control"}
    sent = report.messages["roi"]
    assert 1 < sent < FRAMES  # some frames share a message
    assert report.messages == {"base": FRAMES, "roi": sent, "control": 4}
    account = report.account
    assert sum(report.line_bytes.values()) == account.line_bytes
    assert account.messages == {"base": FRAMES, "roi": sent, "backlog": 0, "meta": 4}
    assert report.bps("base") == account.base_bps
    assert report.bps("roi") == account.roi_bps
    assert report.bps() == account.total_bps
    assert all(report.line_bytes[row] > 90 * report.messages[row] for row in report.line_bytes)
    assert 0 < report.max_frame_bytes < report.line_bytes["roi"]


@pytest.mark.parametrize("settings", [{}, {"share": 0.3}, {"share": 0.7, "segment_s": 0.2}, {"fps": 5}])
def test_everything_together_stays_within_the_budget(tmp_path_factory, settings):
    """The study compares at equal bits; these pictures are noise, and take all that there is."""
    pictures = hard_pictures(FRAMES, size=SIZE)
    clip = clip_of(pictures, tmp_path_factory.mktemp("hard"))
    everywhere = _Everywhere()
    report = flown(clip, detector=everywhere, **settings)
    assert report.account.worst_window_bps.total <= BUDGET_BPS
    assert 0.75 * BUDGET_BPS < report.bps() <= BUDGET_BPS
    seen_twice = everywhere.asked - report.messages["base"]
    assert 0.7 * report.messages["base"] < seen_twice <= report.messages["base"]


class _Everywhere:
    """Unsure of something at every place."""

    class_names = CLASSES

    def __init__(self):
        self.asked = 0

    def detect(self, image_bgr):
        self.asked += 1
        high, wide = image_bgr.shape[:2]
        corners = [(x, y) for x in range(0, wide - 40, 64) for y in range(0, high - 40, 64)]
        boxes = np.array([(x, y, x + 40, y + 40) for x, y in corners], np.float32)
        return Detections(boxes, np.full(len(boxes), 0.4, np.float32), np.zeros(len(boxes), np.int32))


def test_the_same_flight_twice(clip, report):
    """A table that changes from run to run proves nothing."""
    again = flown(clip, scale=0.3)
    assert again.digest == report.digest
    assert again.link == report.link
    assert again.line_bytes == report.line_bytes
    for one, other in zip(again.lists, report.lists, strict=True):
        assert one.class_names == other.class_names
        assert np.array_equal(one.boxes_xyxy_px, other.boxes_xyxy_px)
    assert flown(clip, scale=0.3, share=0.6).digest != report.digest


def test_an_empty_picture_asks_for_nothing(tmp_path_factory):
    """Questions and second passes about nothing would be bits thrown away."""
    pictures = [np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)] * 20
    report = flown(clip_of(pictures, tmp_path_factory.mktemp("empty")))
    assert set(report.line_bytes) == {"base"}
    assert all(not len(one.class_names) for one in report.lists)
    assert all(one.detections is not None for one in report.lists)
    assert len(report.lists) == 20


def test_what_the_ground_is_sure_of_is_not_sent_again(clip):
    """A confident result costs one pass, not two."""
    detector = Doubtful(sharp=0.9, blurred=0.9)
    report = flown(clip, detector=detector)
    assert set(report.line_bytes) == {"base"}
    assert detector.asked == FRAMES
    assert f1_of(report, range(2, 40)) > 0.9


def test_delay_is_that_of_the_pass_that_completes_a_frame(report, clip):
    """Two passes are bought with delay; a table that hid it would mislead."""
    # A segment of a second has to be whole before its question: its first frame waits for at least 14 frames.
    assert report.link.delay_p95_ms > 930
    quick = flown(clip, scale=0.3, segment_s=0.2)
    assert quick.link.delay_p50_ms < report.link.delay_p50_ms
    assert quick.messages["control"] > 3 * report.messages["control"]
    assert report.picture_age_p95_ms < 400  # of the first pass, which does not wait


def test_frames_between_coded_ones_are_predicted(clip):
    """Judged on coded frames only, a slow stream would look as good as a fast one."""
    report = flown(clip, scale=0.3, fps=5)
    assert report.messages["base"] == 16
    coded = [frame_index for frame_index, one in enumerate(report.lists) if one.detections is not None]
    assert coded == list(range(0, FRAMES, 3))
    truth = [None] * FRAMES
    assert len(detected_frames(report.lists, truth)) == 16
    between = [frame_index for frame_index in range(9, 40) if frame_index % 3]
    assert f1_of(report, between) > 0.8


def test_boxes_are_in_source_pixels(tmp_path_factory):
    """Labels are: a list in base pixels would match nothing."""
    small = smooth_pictures(12, size=SIZE)
    large = [cv2.resize(one, (640, 384), interpolation=cv2.INTER_NEAREST) for one in small]
    report = flown(clip_of(large, tmp_path_factory.mktemp("large")), detector=RedSquares())
    (box,) = report.lists[5].boxes_xyxy_px
    assert np.abs(box - 2 * np.array(square_box(5))).max() < 8


def test_a_budget_for_one_pass_only_is_told_in_a_sentence(clip):
    """x265 would spend more than it was given, and the run would be one at another budget."""
    with pytest.raises(UserError, match="DDS with 30000 bps"):
        flown(clip, budget_bps=30_000)
