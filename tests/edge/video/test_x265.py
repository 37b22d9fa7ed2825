"""The base stream, out of the real x265."""

import os
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from av.filter import Graph
from hypothesis import given
from hypothesis import strategies as st

from hvt_common.errors import UserError
from hvt_common.values import Tracks
from hvt_common.video.hevc import BaseDecoder
from hvt_edge.video import x265
from hvt_edge.video.encoder import PRESETS, EncoderSettings, keyframe_floor_bytes, minimum_bps
from hvt_edge.video.x265 import MOST_REGIONS, BaseEncoder, Region, TrackRegions
from media.clips import framed, hard_pictures, smooth_pictures
from rigs.examples import tracks_of

SIZE = (320, 192)
VPS, SPS, PPS, IDR, FILLER = 32, 33, 34, (19, 20), 38


def settings(**changes) -> EncoderSettings:
    return EncoderSettings(**{"size": SIZE, "fps": 15.0, "bitrate_bps": 200_000} | changes)


def nal_types(data: bytes) -> list[int]:
    """Types of the NAL units in an access unit (H.265, 7.3.1.2)."""
    assert data.startswith((b"\x00\x00\x01", b"\x00\x00\x00\x01"))
    return [part[0] >> 1 & 0x3F for part in data.split(b"\x00\x00\x01")[1:]]


def is_idr(data: bytes) -> bool:
    """Whether decoding can start here, with nothing from elsewhere."""
    types = nal_types(data)
    return {VPS, SPS, PPS} <= set(types) and any(one in IDR for one in types)


def encode(pictures, keyframes=(), regions=lambda _index: (), **changes):
    encoder = BaseEncoder(settings(**changes))
    return [
        encoder.encode(frame, keyframe=frame.index in keyframes, regions=regions(frame.index))
        for frame in framed(pictures)
    ]


def decoded(units):
    decoder = BaseDecoder()
    return [decoder.decode(unit.data) for unit in units]


def errors_of(pictures, units):
    """(height, width, 3) differences of the last pictures."""
    return [
        one.astype(np.float64) - picture
        for one, picture in zip(decoded(units)[-6:], pictures[-6:], strict=True)
    ]


def errors_at(pictures, units, box):
    """Mean square error inside a box and outside it, over the last pictures."""
    inside = np.zeros(pictures[0].shape[:2], bool)
    inside[box[1] : box[3], box[0] : box[2]] = True
    square = np.mean(np.square(errors_of(pictures, units)), axis=(0, -1))
    return float(square[inside].mean()), float(square[~inside].mean())


def test_each_frame_gives_its_unit_at_once():
    """The operator would see the world one or more frames late."""
    frames = framed(pictures := smooth_pictures(20, size=SIZE))
    units = encode(pictures)
    assert [(one.frame_index, one.capture_ns) for one in units] == [
        (one.index, one.capture_ns) for one in frames
    ]
    assert all(nal_types(unit.data) for unit in units)


@pytest.mark.parametrize("preset", ["ultrafast", "veryfast"])
def test_a_keyframe_comes_when_it_is_asked_for_and_only_then(preset):
    """A ground that joined late could not start at it; or keyframes would come that no budget was held for."""
    asked = (1, 4, 5, 12, 29)  # also right after another one, and at the cut
    units = encode(hard_pictures(58, size=SIZE), keyframes=asked, preset=preset)
    assert [unit.frame_index for unit in units if unit.keyframe] == [0, *asked]
    assert [unit.frame_index for unit in units if is_idr(unit.data)] == [0, *asked]
    assert all(one is not None for start in asked for one in decoded(units[start : start + 3]))


@pytest.mark.skipif(sys.platform != "linux", reason="it is about Linux's niceness")
@pytest.mark.skipif(os.nice(0) >= 10, reason="what runs these tests has a priority as low as x265's workers")
def test_its_workers_have_the_priority_of_the_frame_loop(monkeypatch):
    """x265 lowers it by 10, to that of detection: each frame would wait behind a network."""
    raised: dict[int, int] = {}
    set_priority = os.setpriority

    def noted(which: int, thread: int, niceness: int) -> None:
        raised[thread] = niceness
        set_priority(which, thread, niceness)

    monkeypatch.setattr(os, "setpriority", noted)
    own = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    before = {one.name for one in Path("/proc/self/task").iterdir()}
    encoder = BaseEncoder(EncoderSettings(size=(1280, 720), fps=15, bitrate_bps=400_000, threads=2))
    for frame in framed(smooth_pictures(4, size=(1280, 720))):
        encoder.encode(frame, keyframe=True)
    assert raised, "a worker was found at a lower priority"
    assert not {str(one) for one in raised} & before
    assert set(raised.values()) == {own}


def test_the_same_pictures_give_the_same_bytes():
    """No table of the study and no bug report could be repeated."""
    pictures = hard_pictures(40, size=SIZE)
    first, second = (encode(pictures, keyframes=(7, 30)) for _ in range(2))
    assert [unit.data for unit in first] == [unit.data for unit in second]


def test_what_comes_back_is_what_went_in():
    """Colours would be off for every viewer and every detector behind it."""
    pictures = smooth_pictures(10, size=SIZE)
    *_, error = errors_of(pictures, encode(pictures, bitrate_bps=600_000))
    luma = error @ np.array([0.0722, 0.7152, 0.2126])
    assert abs(luma.mean()) < 0.3
    assert np.abs(error.mean(axis=(0, 1))).max() < 0.5
    assert 10 * np.log10(255**2 / (luma**2).mean()) > 40


def test_the_given_arrays_are_left_alone():
    """Stills are cropped later from the very frame that was encoded."""
    pictures = hard_pictures(3, size=SIZE)
    copies = [picture.copy() for picture in pictures]
    encode(pictures)
    assert all(np.array_equal(one, other) for one, other in zip(pictures, copies, strict=True))


@pytest.mark.parametrize("size", [(64, 64), (1920, 1080), (322, 178)])
@pytest.mark.parametrize("fps", [0.5, 29.97])
def test_sizes_and_rates_at_the_rim_work(size, fps):
    """An odd camera could not be used."""
    rim = {"size": size, "fps": fps, "bitrate_bps": 500_000, "preset": "ultrafast"}
    shown = decoded(encode(smooth_pictures(3, size=size), **rim))
    assert [one.shape for one in shown] == [(size[1], size[0], 3)] * 3


def test_what_x265_refuses_is_one_sentence():
    """A traceback out of a C library in place of the setting's name."""
    with pytest.raises(UserError, match="x265 does not take 16x8 at 15 fps and 200 kbps"):
        BaseEncoder(settings(size=(16, 8)))


def test_every_preset_opens():
    """A preset that ``--help`` names would end the edge at its start."""
    for preset in PRESETS:
        assert encode(smooth_pictures(1, size=(64, 64)), size=(64, 64), preset=preset)[0].keyframe


@pytest.mark.parametrize(
    ("size", "count"),
    [((320, 180), 150), pytest.param((640, 360), 150, marks=pytest.mark.nightly), ((1280, 720), 60)],
)
def test_at_the_minimum_the_target_is_still_followed(size, count):
    """``hvt-edge`` would accept a budget that its base stream then overspends."""
    target = minimum_bps(size, 15)
    units = encode(hard_pictures(count, size=size), size=size, bitrate_bps=target)
    assert 0.3 * keyframe_floor_bytes(size) < len(units[0].data) < 1.1 * keyframe_floor_bytes(size)
    assert b"x265" not in units[0].data
    run_bps = 8 * sum(len(unit.data) for unit in units[1:]) / (count / 15)
    assert run_bps <= 1.1 * target


BOX = (96, 64, 192, 128)


@pytest.mark.parametrize("preset", ["ultrafast", "superfast", "veryfast"])
def test_a_region_gets_a_better_picture(preset):
    """R0 would change nothing."""
    pictures = hard_pictures(24, size=SIZE)[:20]
    plain = errors_at(pictures, encode(pictures, preset=preset), BOX)
    units = encode(pictures, preset=preset, regions=lambda _: [Region(BOX, -0.2)])
    better = errors_at(pictures, units, BOX)
    assert better[0] < 0.7 * plain[0]
    assert better[1] > plain[1], "the rest pays for it"


def test_where_regions_overlap_the_deeper_one_counts():
    """A track beside another would lose what it has."""
    pictures = hard_pictures(24, size=SIZE)[:16]
    both = [Region((0, 0, *SIZE), 0.1), Region(BOX, -0.2)]
    first, second = (encode(pictures, regions=lambda _, order=order: order) for order in (both, both[::-1]))
    assert [unit.data for unit in first] == [unit.data for unit in second]
    inside, outside = errors_at(pictures, first, BOX)
    assert inside < 0.7 * outside


def test_regions_that_come_late_and_go_again_are_safe():
    """x265 ends the process where side data comes to a stream that began without."""
    pictures = hard_pictures(30, size=SIZE)
    wanted = {10: [Region(BOX, -0.3)], 11: [Region((0, 0, *SIZE), -0.3)], 20: [Region(BOX, 0.2)] * 300}
    units = encode(pictures, keyframes=(15,), regions=lambda index: wanted.get(index, ()))
    plain = encode(pictures, keyframes=(15,))
    assert [unit.data for unit in units[:10]] == [unit.data for unit in plain[:10]]
    assert units[10].data != plain[10].data
    assert all(one is not None for one in decoded(units))


@pytest.mark.parametrize(
    ("box", "offset"),
    [
        *(((-50, -50, 10, 10), -0.2), ((300, 180, 5000, 5000), -0.2), ((40, 40, 40, 90), -0.2)),
        *(((90, 90, 40, 40), -0.2), ((900, 900, 950, 950), -0.2), (BOX, -7.0), (BOX, float("nan"))),
    ],
)
def test_a_region_at_or_beyond_the_rim_is_cut(box, offset):
    """A track that leaves the picture would end the edge."""
    units = encode(hard_pictures(6, size=SIZE), regions=lambda index: [Region(box, offset)] * (index % 2))
    assert all(one is not None for one in decoded(units))


def test_more_regions_than_are_taken_are_left_out():
    """A crowd of a thousand tracks would cost more time than its frame."""
    pictures = hard_pictures(4, size=SIZE)
    wanted = [Region((x, y, x + 8, y + 8), -0.1) for x in range(0, 320, 8) for y in range(0, 192, 8)]
    assert len(wanted) > MOST_REGIONS
    all_of_them, few = (
        [one.data for one in encode(pictures, regions=lambda _, some=some: some)]
        for some in (wanted, wanted[:MOST_REGIONS])
    )
    assert all_of_them == few


def test_regions_that_stay_are_not_set_up_again(monkeypatch):
    """Half a millisecond of each picture's time would go for the same cars on the same car park."""
    made = []
    monkeypatch.setattr(x265, "Graph", lambda: made.append(Graph()) or made[-1])
    pictures, wanted = hard_pictures(6, size=SIZE), [Region(BOX, -0.2)]
    units = encode(pictures, bitrate_bps=40_000, regions=lambda index: [*wanted] if index > 1 else ())
    assert (len(units), len(made)) == (6, 2)


def test_the_quantiser_is_told():
    """``--fps auto`` would decide on nothing."""
    pictures = hard_pictures(12, size=SIZE)
    means = []
    for bitrate in (100_000, 800_000):
        encoder = BaseEncoder(settings(bitrate_bps=bitrate))
        for frame in framed(pictures):
            encoder.encode(frame)
        means.append(encoder.mean_qp)
    assert 0 < means[1] < means[0] - 4
    assert means[0] <= 51 + 6


def test_a_new_encoder_goes_on_in_the_same_stream():
    """A change of frame rate would stop the ground's decoder, or mix two pictures."""
    pictures = hard_pictures(20, size=SIZE)
    parts = (pictures[:10], 15.0), (pictures[10::3], 5.0)
    units = [
        unit for part, fps in parts for unit in encode(part, bitrate_bps=800_000, fps=fps, keyframes=(0,))
    ]
    for one, picture in zip(decoded(units), [*pictures[:10], *pictures[10::3]], strict=True):
        assert abs((one.astype(np.float64) - picture).mean()) < 3


def still_scene(count: int, *, noise: float) -> list[np.ndarray]:
    chance, scene = np.random.default_rng(5), hard_pictures(1, size=SIZE)[0].astype(np.float64)
    grain = (chance.normal(0, noise, scene.shape) for _ in range(count))
    return [np.clip(scene + one, 0, 255).astype(np.uint8) for one in grain]


@pytest.mark.parametrize("preset", ["superfast", "veryfast"])
def test_a_still_camera_uses_its_rate_after_a_keyframe(preset):
    """x265 left half of it unused for five seconds, while the picture was as coarse as the keyframe."""
    units = encode(still_scene(75, noise=6), keyframes=(30,), preset=preset)
    bits = [8 * len(unit.data) for unit in units]
    assert sum(bits[31:]) * 15 / 44 >= 0.75 * 200_000
    assert max(sum(bits[start : start + 15]) for start in range(61)) <= 1.1 * 200_000
    assert FILLER not in {kind for unit in units for kind in nal_types(unit.data)}


@pytest.mark.parametrize(("fps", "bitrate_bps"), [(5.0, 80_000), (15.0, 200_000)])
def test_a_keyframe_is_as_good_whatever_came_before(fps, bitrate_bps):
    """That of a still scene came at QP 51, a tenth of its bits used: x265 held the frames before against it."""
    given = {"fps": fps, "bitrate_bps": bitrate_bps, "vbv_s": max(0.15, 1.3 / fps)}
    units = encode(still_scene(40, noise=2), keyframes=(30,), **given)
    assert len(units[30].data) > 0.8 * len(units[0].data)
    assert is_idr(units[30].data)


WIDE = (640, 360)


def tracks(*boxes, confidences=None) -> Tracks:
    return tracks_of(0, boxes, confidences=0.5 if confidences is None else confidences)


def test_tracks_are_quantised_finer_with_a_margin():
    """R0 would be M0 under another name, or the outline of a car stay in the poor part."""
    plan = TrackRegions(WIDE, depth=0.1, padding=0.0)
    assert plan.regions(tracks((33, 20, 60, 40))) == [Region((32, 16, 64, 48), -0.1)]
    assert plan.regions(None) == plan.regions(tracks()) == []
    plan = TrackRegions(WIDE, depth=0.1, padding=0.5)
    assert plan.regions(tracks((600, 340, 639, 359)))[0].box_px == (576, 320, 640, 360)


def test_tracks_that_fill_the_picture_are_quantised_less_fine():
    """Everything would be important: x265 would take the bits from the very same tracks, and lose quality."""
    plan = TrackRegions(WIDE, depth=0.1, padding=0.0, free_share=0.1)
    (one,) = plan.regions(tracks((0, 0, 320, 352)))
    assert -0.03 < one.offset < -0.015
    two = plan.regions(tracks((0, 0, 320, 352), (0, 0, 320, 352)))
    assert [region.offset for region in two] == [one.offset] * 2, "what overlaps covers once"


def test_the_surest_tracks_stay_where_there_are_too_many():
    """The cars would lose their place to what is hardly one."""
    boxes = [
        (16 * (index % 40), 16 * (index // 40), 16 * (index % 40) + 8, 16 * (index // 40) + 8)
        for index in range(200)
    ]
    plan = TrackRegions(WIDE, depth=0.1, padding=0.0)
    regions = plan.regions(tracks(*boxes, confidences=[0.2] * 100 + [0.9] * 100))
    assert len(regions) == MOST_REGIONS
    assert min(region.box_px[1] for region in regions) >= 32


@given(
    boxes=st.lists(st.tuples(*[st.floats(-2000, 4000, width=32) | st.just(float("nan"))] * 4), max_size=30)
)
def test_no_box_of_a_tracker_breaks_a_plan(boxes):
    """A track that leaves the picture, or whose filter ran away, would end the edge."""
    held = tracks(*boxes)
    for region in TrackRegions(WIDE, depth=0.1).regions(held):
        x1, y1, x2, y2 = region.box_px
        assert 0 <= x1 < x2 <= 640
        assert 0 <= y1 < y2 <= 360
        assert -0.1 <= region.offset < 0
