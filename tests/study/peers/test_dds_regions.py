"""What the two-pass peer asks for: cases that can be worked out by hand."""

import zlib

import numpy as np
import pytest

from hvt_common.values import Detections
from hvt_study.peers import dds_regions as regions

SIZE = (320, 192)
RULES = regions.DdsSettings(low=0.2, high=0.6, overlap_iou=0.3, max_area=0.1, merge_iou=0.3, enlarge=0.0)


def seen(*rows):
    """Rows of (x1, y1, x2, y2, confidence), all of class 0."""
    table = np.array(rows, np.float32).reshape(-1, 5)
    return Detections(table[:, :4], table[:, 4], np.zeros(len(table), np.int32))


def requested(*rows, rules=RULES):
    return regions.requested_boxes(seen(*rows), size=SIZE, settings=rules).tolist()


SURE = (100, 100, 120, 120, 0.9)
ENLARGED = regions.DdsSettings(low=0.2, high=0.6, enlarge=0.5)


@pytest.mark.parametrize(
    ("rows", "boxes"),
    [
        # Only what is uncertain: asked about what it knows, the peer would spend its second pass on nothing.
        ([(10, 10, 30, 30, 0.6), (50, 10, 70, 30, 0.59)], [[50, 10, 70, 30]]),
        ([(90, 10, 110, 30, 0.2), (130, 10, 150, 30, 0.19)], [[90, 10, 110, 30]]),
        ([], []),
        ([(10, 10, 30, 30, 0.9)], []),
        # Not the detector's second thoughts about one and the same car:
        # 20x20 moved by 10: 200 shared of 600, IoU 1/3; by 11: 180 of 620, 0.29.
        ([SURE, (110, 100, 130, 120, 0.4)], []),
        ([SURE, (111, 100, 131, 120, 0.4)], [[111, 100, 131, 120]]),
        # No large lorry, which would take the bits of all that is far away: a tenth of 320x192 is 6144.
        ([(0, 0, 96, 64, 0.4)], [[0, 0, 96, 64]]),
        ([(0, 0, 97, 64, 0.4)], []),
    ],
)
def test_what_is_asked_for(rows, boxes):
    """The second pass would be spent on what is known, or on one large thing."""
    assert requested(*rows) == boxes


def test_overlapping_regions_become_one():
    """A chain of overlaps is one region, whatever the order in which it was found."""
    left, middle, right = (0, 0, 20, 20), (10, 0, 30, 20), (20, 0, 40, 20)
    apart = (100, 100, 110, 110)
    boxes = np.array([left, right, apart, middle], np.float32)
    # Left and middle share 200 of 600, 1/3; left and right nothing.
    assert sorted(regions.merged(boxes, over_iou=0.3).tolist()) == [[0, 0, 40, 20], [100, 100, 110, 110]]
    assert len(regions.merged(boxes, over_iou=0.34)) == 4
    assert regions.merged(boxes[:1], over_iou=0.3).tolist() == [list(left)]


def test_regions_are_enlarged_within_the_picture():
    """A box that is a little too small cuts the object that it is about."""
    assert requested((100, 100, 120, 110, 0.4), rules=ENLARGED) == [[90, 95, 130, 115]]
    assert requested((0, 180, 20, 192, 0.4), rules=ENLARGED) == [[0, 174, 30, 192]]


def test_blocks_and_pixels():
    """The edge and the ground have to mean the same pixels, also at a rim that is no whole block."""
    size = (40, 24)
    blocks = regions.requested_blocks(np.array([[15, 15, 17, 17]], np.float32), size=size, align_px=16)
    assert blocks.tolist() == [[True, True, False], [True, True, False]]
    exact = regions.requested_blocks(np.array([[16, 0, 32, 16]], np.float32), size=size, align_px=16)
    assert exact.tolist() == [[False, True, False], [False, False, False]]
    corner = regions.requested_blocks(np.array([[33, 17, 40, 24]], np.float32), size=size, align_px=16)
    mask = regions.pixel_mask(corner, size=size, align_px=16)
    assert mask.shape == (24, 40)
    assert mask.sum() == 8 * 8
    assert mask[16:, 32:].all()
    over, under = np.full((24, 40, 3), 200, np.uint8), np.full((24, 40, 3), 50, np.uint8)
    picture = regions.pasted(under, over, corner, align_px=16)
    assert picture[20, 36].tolist() == [200] * 3
    assert picture[20, 31].tolist() == [50] * 3
    assert regions.pasted(None, over, corner, align_px=16)[0, 0].tolist() == [0] * 3
    assert (under == 50).all()


def test_both_passes_are_combined_without_doubles():
    """Shown twice, every car would count as a false alarm."""
    first = seen((10, 10, 30, 30, 0.7), (50, 10, 70, 30, 0.4), (200, 10, 220, 30, 0.65))
    second = seen((11, 10, 31, 30, 0.8), (50, 10, 70, 30, 0.9), (90, 10, 110, 30, 0.3))
    found = regions.combined(first, second, settings=RULES)
    # The first pass's 0.7 is the second's 0.8; its 0.4 was no result; its 0.65 stays.
    assert [round(float(one), 2) for one in found.confidences] == [0.9, 0.8, 0.65, 0.3]
    assert found.boxes_xyxy_px[:, 0].tolist() == [50, 11, 200, 90]


def test_a_question_comes_back_as_it_was():
    """The edge would send other pixels than the ground pastes."""
    rng = np.random.default_rng(5)
    frames = tuple(rng.random((12, 20)) < share for share in (0.1, 0.0, 0.5, 0.5))
    read = regions.RegionRequest.parse(regions.RegionRequest(4711, frames).pack(), grid=(12, 20))
    assert read.first_frame == 4711
    assert len(read.frames) == 4
    assert all(np.array_equal(a, b) for a, b in zip(read.frames, frames, strict=True))


def test_regions_that_stay_cost_next_to_nothing():
    """Questions count: a segment of fifteen equal masks may not cost fifteen times one."""
    mask = np.random.default_rng(5).random((45, 80)) < 0.05
    one, many = (len(regions.RegionRequest(0, (mask,) * count).pack()) for count in (1, 15))
    assert many < one + 60


@pytest.mark.parametrize(
    "spoil",
    [
        *(lambda _: b"", lambda data: data[:-9], lambda data: data[:5] + b"\xff" + data[6:]),
        lambda data: data[:4] + b"\x09" + data[5:],
        lambda data: data[:5] + zlib.compress(bytes(1_000_000)),
    ],
)
def test_a_spoilt_question_is_refused(spoil):
    """Bytes from outside may neither crash the edge nor fill its memory."""
    data = regions.RegionRequest(3, (np.eye(12, 20, dtype=bool),) * 3).pack()
    with pytest.raises(ValueError, match="request"):
        regions.RegionRequest.parse(spoil(data), grid=(12, 20))
