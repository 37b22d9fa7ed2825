"""Resampling in time and space."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_common.units import exact_rate
from hvt_common.values import View
from hvt_edge.source.resample import Gate, Resizer, base_frame_count, capture_time_ns, hold

rates = st.fractions(min_value=Fraction(1, 2), max_value=240, max_denominator=1001)


def played(times, fps, *, tail_s, slack_s=Fraction(0)):
    """Hold frames 0, 1, 2 … that were taken at ``times``."""
    stamped = ((t, n) for n, t in enumerate(times))
    return list(hold(stamped, fps=Fraction(fps), tail_s=Fraction(tail_s), slack_s=slack_s))


@given(source=rates, base=rates, count=st.integers(1, 200), start=st.fractions(-5, 5, max_denominator=90_000))
def test_any_rate_shows_the_latest_frame_at_or_before_each_instant(source, base, count, start):
    """A clip of any rate would stutter, drift, or show the future."""
    out = played([start + n / source for n in range(count)], base, tail_s=1 / source)
    assert [index for index, _ in out] == list(range(len(out)))
    assert [n for _, n in out] == [int(index / base * source) for index in range(len(out))]
    assert len(out) == base_frame_count(count / source, fps=base)


@given(
    gaps=st.lists(st.fractions(Fraction(1, 1000), 2, max_denominator=1000), min_size=1, max_size=60),
    base=rates,
)
def test_a_variable_frame_rate_is_held_between_its_frames(gaps, base):
    """Phone clips, which vary their rate, would run fast and slow."""
    times = [Fraction(0)]
    for gap in gaps:
        times.append(times[-1] + gap)
    out = played(times, base, tail_s=Fraction(1, 30))
    for index, shown in out:
        assert shown == max(n for n, t in enumerate(times) if t <= index / base)
    assert len(out) / base >= times[-1]


@pytest.mark.parametrize(
    ("source", "base"), [("30000/1001", "15"), ("24000/1001", "30"), ("25", "15"), ("60", "15")]
)
def test_four_hours_do_not_drift(source, base):
    """Long flights would come apart from their telemetry, a frame every few minutes."""
    source, base = Fraction(source), Fraction(base)
    seconds = 4 * 3600
    last = int(seconds * source) - 1
    # Only the end is looked at: everything before it is one frame that is held.
    out = list(hold([(Fraction(0), 0), (last / source, last)], fps=base, tail_s=1 / source))
    assert len(out) == base_frame_count((last + 1) / source, fps=base)
    assert abs(len(out) - seconds * base) <= 1
    exact = out[-1][0] / base
    assert abs(capture_time_ns(out[-1][0], fps=base, start_ns=7) - 7 - exact * 10**9) <= Fraction(1, 2)


def test_matroska_milliseconds_do_not_make_frames_slip():
    """Half rate of a 30 fps Matroska clip would repeat and lose frames, because 66.67 ms is stored as 67."""
    rounded = [Fraction(round(n * 1000 / 30), 1000) for n in range(300)]
    slipped = [n for _, n in played(rounded, 15, tail_s=Fraction(1, 30))]
    exact = [n for _, n in played(rounded, 15, tail_s=Fraction(1, 30), slack_s=Fraction(1, 1000))]
    assert exact == list(range(0, 300, 2))
    assert slipped != exact


def test_time_stamps_that_run_backwards_replace_and_never_rewind():
    """One broken time stamp would end the clip or play a part of it twice; an empty clip would crash."""
    out = played([Fraction(t) for t in ("0", "0.2", "0.1", "0.1", "0.4")], 10, tail_s="0.1")
    assert out == [(0, 0), (1, 0), (2, 3), (3, 3), (4, 4)]
    assert played([Fraction(3)], 15, tail_s="0.001") == [(0, 0)]
    assert played([], 15, tail_s="0.1") == []


@given(camera=st.floats(5, 120), base=st.floats(1, 60), jitter=st.integers(0, 2**32 - 1))
@settings(max_examples=60)
def test_a_jittery_camera_is_brought_to_the_base_rate_on_average(camera, base, jitter):
    """A 30 fps camera at 15 fps would slip to 10 fps, or overrun the encoder's budget."""
    rng = np.random.default_rng(jitter)
    times = (np.arange(400) + rng.uniform(-0.2, 0.2, 400)) / camera
    gate = Gate(base)
    taken = [t for t in times if gate.accept(round(t * 1e9))]
    seconds = times[-1] - times[0]
    assert len(taken) <= seconds * base * 1.01 + 2
    if camera <= 0.6 * base:
        assert len(taken) == 400  # a slower camera is taken whole
    if camera >= 2 * base:
        assert len(taken) >= seconds * base * 0.97 - 2


def test_a_camera_that_pauses_does_not_burst_afterwards():
    """After a stall the link would be flooded with frames that catch up."""
    gate = Gate(10)
    before = [n * 0.02 for n in range(50)]
    after = [60 + n * 0.02 for n in range(50)]
    taken = [t for t in before + after if gate.accept(round(t * 1e9))]
    assert len([t for t in taken if 60 <= t < 60.9]) == 10


def test_of_frames_that_were_left_out_those_count_that_were_due():
    """Of a camera of 60 frames a second four times as many would be called lost as could be seen."""
    gate = Gate(10)
    assert gate.wanted(5, before_ns=10**9) == 0, "before the first none was due"
    gate.accept(0)
    assert [gate.wanted(count, before_ns=10**9) for count in (60, 5, 0)] == [9, 5, 0]
    assert gate.wanted(60, before_ns=10**8) == 0
    assert gate.wanted(1, before_ns=2 * 10**8 - 1) == 1, "stamps are rounded"


@given(
    source=st.tuples(st.integers(16, 4000), st.integers(16, 4000)),
    base=st.tuples(st.integers(32, 2000), st.integers(32, 2000)),
    fit=st.sampled_from(["letterbox", "crop"]),
    box=st.tuples(*[st.floats(0, 1)] * 4),
)
def test_boxes_survive_the_round_trip_between_source_and_base(source, base, fit, box):
    """Stills would be cropped beside the object that the detector saw in the base frame."""
    view = View.fitted(source, base, fit=fit)
    x = sorted(np.array(box[:2]) * source[0])
    y = sorted(np.array(box[2:]) * source[1])
    boxes = np.array([[x[0], y[0], x[1], y[1]]], np.float32)
    assert np.allclose(
        view.to_source(view.to_base(boxes)), boxes, atol=0.01 + 2e-6 * max(source) / view.scale
    )


@pytest.mark.parametrize("fit", ["letterbox", "crop"])
@pytest.mark.parametrize(
    ("source", "base"),
    [
        *((source, (1280, 720)) for source in ((1100, 720), (1920, 1080), (720, 1280))),
        ((333, 517), (640, 360)),
    ],
)
def test_the_picture_lies_where_the_view_says(source, base, fit):
    """Every box on the ground would be off by the error of the resizer."""
    resizer = Resizer(source, base, fit=fit)
    picture = np.zeros((*source[::-1], 3), np.uint8)
    # A bright square round the middle third, which both fits keep.
    x0, y0, x1, y1 = (side // 2 + part * (side // 10) for part in (-1, 1) for side in source)
    picture[y0:y1, x0:x1] = 255
    frame = resizer.frame(picture, index=0, capture_ns=0)
    assert frame.base_bgr.shape == (base[1], base[0], 3)
    rows, columns = np.nonzero(frame.base_bgr[..., 0] > 127)
    found = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
    expected = resizer.view.to_base(np.array([[x0, y0, x1, y1]], np.float32))[0]
    assert np.abs(found - expected).max() <= 1.0


def test_equal_sizes_are_not_copied_and_arrays_are_read_only():
    """Four megabytes a frame would be copied for nothing, or a stage would draw into the still's source."""
    picture = np.zeros((72, 128, 3), np.uint8)
    frame = Resizer((128, 72), (128, 72), fit="letterbox").frame(picture, index=3, capture_ns=5)
    assert frame.base_bgr is frame.source_bgr
    assert (frame.index, frame.capture_ns) == (3, 5)
    with pytest.raises(ValueError, match="read-only"):
        frame.base_bgr[0, 0] = 1


def test_fine_texture_is_averaged_and_not_aliased():
    """Roofs and gravel would flicker in the base stream and eat its bits."""
    stripes = np.zeros((360, 640, 3), np.uint8)
    stripes[:, ::2] = 255
    frame = Resizer((640, 360), (214, 120), fit="crop").frame(stripes, index=0, capture_ns=0)
    assert frame.base_bgr.std() < 50  # picking single pixels gives about 127


@pytest.mark.parametrize(
    ("sizes", "told"),
    [
        ([(64, 48), (640, 480), (640, 480), (64, 48), (640, 480), (48, 64)], ["640x480", "48x64"]),
        # A folder of photographs, each of a size of its own, wrote a warning for each.
        ([(wide, 48) for wide in range(64, 96)], ["65x48", "66x48", "67x48"]),
    ],
)
def test_pictures_of_another_size_are_told_of_once(caplog, sizes, told):
    """A stream that begins small, or a folder with a thumbnail in front, was small to its end without a word."""
    resizer = Resizer((64, 48), (64, 48), fit="letterbox", name="cam")
    for index, size in enumerate(sizes):
        resizer.frame(np.full((*size[::-1], 3), index, np.uint8), index=index, capture_ns=index)
    said = [record.message.partition(",")[0] for record in caplog.records]
    assert said == [f"cam: a picture is {size}" for size in told]


def test_broadcast_rates_are_exact():
    """29.97 typed by a user and 30000/1001 from a container would drift apart from what was meant."""
    assert exact_rate(30000 / 1001) == Fraction(30000, 1001)
    assert exact_rate(29.97) == Fraction(2997, 100)
    assert exact_rate(15) == 15
