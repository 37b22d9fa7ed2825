"""A closer look is closer than the video: how a requested crop is coded, and what it takes of the video."""

import itertools
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_common.values import Image
from hvt_common.video.still_codecs import JpegCodec, psnr_y_db
from hvt_edge.link.budget import BudgetSettings, RollingBudget
from hvt_edge.link.stills import Alternative, Still
from hvt_edge.stills.requested_coding import Capacity, RefusedError, code_requested
from media.clips import START_NS, hard_pictures
from media.pictures import write_scene
from rigs.closer_looks import LookFlight, RequestedLook
from rigs.messages import still_of

SIZE = (240, 160)
CROP = hard_pictures(1, size=SIZE)[0]
JPEG = JpegCodec()
PLENTY = Capacity(prompt_bytes=100_000, most_bytes=150_000, total_bps=1_500_000)


def job(base: Image | None, *, quality_pct: int = 65) -> Still:
    whole = (slice(0, SIZE[1]), slice(0, SIZE[0]))
    alternative = None
    if base is not None:
        alternative = Alternative.of(base, crop=CROP, places=(whole,), min_gain_db=0.0)
    whole_px = {"box_source_px": (0.0, 0.0, *map(float, SIZE)), "crop_source_px": (0, 0, *SIZE)}
    return replace(still_of(quality_pct=quality_pct, **whole_px), crop_bgr=CROP, alternative=alternative)


def as_base(quality_pct: int) -> Image:
    coded = JPEG.encode(CROP, quality_pct=quality_pct)
    return JPEG.decode(coded.data, size=SIZE, parameters=coded.parameters)


def shown(still: Still) -> Image:
    size = still.header.parameters.get("w", SIZE[0]), still.header.parameters.get("h", SIZE[1])
    image = JPEG.decode(still.data, size=size, parameters=still.header.parameters)
    return np.asarray(cv2.resize(image, SIZE, interpolation=cv2.INTER_CUBIC), np.uint8)


@settings(max_examples=40)
@given(base_pct=st.integers(1, 99), wanted_pct=st.integers(5, 95), most_bytes=st.integers(200, 60_000))
def test_what_comes_is_closer_to_the_source_than_the_video_and_fits(base_pct, wanted_pct, most_bytes):
    """An operator who looks closer would see less than before, or wait for what never fits."""
    base = as_base(base_pct)
    capacity = Capacity(round(0.6 * most_bytes), most_bytes, total_bps=10 * most_bytes)
    try:
        still, note = code_requested(job(base, quality_pct=wanted_pct), codec=JPEG, capacity=capacity)
    except RefusedError as refused:
        assert "the video" in str(refused)  # noqa: PT017 - either may come
        return
    assert len(still.data) <= most_bytes
    assert psnr_y_db(shown(still), CROP) > psnr_y_db(base, CROP)
    full = "w" not in still.header.parameters
    assert full or note, "fewer pixels are said before they come"


def test_quality_goes_up_until_it_plainly_shows_more_and_down_before_pixels():
    """At the stills' usual quality it would be as good as the video, or small where it could be whole."""
    base = as_base(65)
    better, _ = code_requested(job(base), codec=JPEG, capacity=PLENTY)
    assert better.header.quality_pct > 65
    assert psnr_y_db(shown(better), CROP) > psnr_y_db(base, CROP) + 1.5
    whole = len(JPEG.encode(CROP, quality_pct=65).data)
    thin = Capacity(round(0.5 * whole), round(0.7 * whole), total_bps=8 * whole)
    lower, note = code_requested(job(as_base(10)), codec=JPEG, capacity=thin)
    assert lower.header.quality_pct < 65
    assert "w" not in lower.header.parameters
    assert f"{SIZE[0]}x{SIZE[1]} pixels at quality {lower.header.quality_pct} come within about" in note


@pytest.mark.parametrize(
    ("base", "capacity", "words"),
    [
        (CROP, PLENTY, r"^the video already shows it as well as the source does$"),
        (
            70,
            Capacity(900, 1500, 15_000),
            r"^240x160 pixels take .* 15 kbps carry 1\.5 kB at once beside it: ask",
        ),
        (70, Capacity(0, 0, 150_000), r"150 kbps carry 0\.0 kB at once beside it: raise the budget$"),
    ],
    ids=["as good", "too large", "no room"],
)
def test_what_the_video_shows_as_well_is_refused_and_what_is_too_large_says_what_would_do(
    base, capacity, words
):
    """The request would be answered by a copy of the picture, or by nothing for ten seconds."""
    with pytest.raises(RefusedError, match=words):
        code_requested(job(as_base(base) if isinstance(base, int) else base), codec=JPEG, capacity=capacity)


def test_a_refusal_names_the_least_that_shows_more_and_no_coding_is_made_twice():
    """Who is told of the bytes at the usual quality asks for a smaller region than need be; AVIF takes .5 s each."""
    made: list[tuple[int, int]] = []

    class Counting(JpegCodec):
        def encode(self, crop_bgr, *, quality_pct, base_bgr=None):
            made.append((crop_bgr.shape[1], quality_pct))
            return super().encode(crop_bgr, quality_pct=quality_pct, base_bgr=base_bgr)

    least_kb = len(JPEG.encode(CROP, quality_pct=20).data) / 1000
    with pytest.raises(RefusedError, match=f"^240x160 pixels take {least_kb:.1f} kB to show more"):
        code_requested(job(as_base(5)), codec=Counting(), capacity=Capacity(300, 500, 5_000))
    assert len(made) == len(set(made))


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    total_bps=st.sampled_from([100_000, 300_000, 800_000, 2_000_000]),
    share=st.sampled_from([0.5, 0.8, 0.95, 1.0]),
    fps=st.sampled_from([2.0, 5.0, 7.5, 15.0, 30.0]),
    parts=st.lists(st.floats(0.02, 0.78), min_size=1, max_size=5),
)
def test_the_video_lends_what_is_requested_within_every_window_and_goes_on(
    seed, total_bps, share, fps, parts
):
    """The hard budget would break for a picture, the picture come late, or the video stop for it."""
    rng = np.random.default_rng(seed)
    budget = RollingBudget(BudgetSettings(total_bps, round(share * total_bps), fps=fps))
    step_ns, tick_ns = round(1e9 / fps), 25_000_000
    wanted = [round(part * total_bps / 8) for part in parts]
    sent: list[tuple[int, int]] = []
    base_ns: list[int] = []
    asked_ns = delays = 0
    waits: list[float] = []
    next_frame_ns = now_ns = START_NS
    end_ns = START_NS + 14 * 10**9
    while now_ns < end_ns:
        if now_ns >= next_frame_ns:
            next_frame_ns += step_ns
            size = int(share * total_bps / 8 / fps * rng.uniform(0.6, 1.1))
            at_ns = budget.earliest_ns(size, now_ns=now_ns, base=True)
            if at_ns - now_ns <= 100_000_000 and not budget.leaves_out(now_ns):
                budget.record_base(size, now_ns=at_ns)
                sent.append((at_ns, size))
                base_ns.append(at_ns)
        if now_ns - START_NS > (delays + 1) * 2_500_000_000 and delays < len(wanted):
            size = wanted[delays]
            asked_ns = asked_ns or now_ns
            if size <= budget.requested_allowance(now_ns):
                budget.record_requested(size, now_ns=now_ns)
                sent.append((now_ns, size))
                waits.append((now_ns - asked_ns) / 1e9)
                asked_ns, delays = 0, delays + 1
            else:
                budget.want_requested(size, now_ns=now_ns)
        now_ns += tick_ns
    assert len(waits) == len(wanted)
    assert max(waits) <= 1.1, "a window, and the moment at which it is seen"
    for at_ns, _ in sent:
        assert sum(size for other, size in sent if at_ns - 10**9 < other <= at_ns) <= total_bps / 8
    longest_ns = max(later - one for one, later in itertools.pairwise(base_ns))
    assert longest_ns <= 1.2e9 + 2 * step_ns


def flown(looks: list[RequestedLook], **settings) -> tuple[LookFlight, dict]:
    plain = {"source_fps": 15.0, "size": (480, 270), "preset": "ultrafast", "detector": "motion"}
    flight = LookFlight(plain | settings, looks)
    return flight, flight.run()


FLIGHTS = [
    pytest.param({"method": "M0", "fps": "auto"}, 100_000, marks=pytest.mark.nightly),
    ({"profile": "auto"}, 100_000),
    pytest.param({"method": "M0"}, 300_000, marks=pytest.mark.nightly),
    ({"profile": "paper"}, 300_000),
    pytest.param({"profile": "thin"}, 300_000, marks=pytest.mark.nightly),
    pytest.param({"profile": "auto", "video_share": 1.0}, 300_000, marks=pytest.mark.nightly),
    ({"profile": "tracks"}, 2_000_000),
]
BOXES = [(400, 200, 64, 48), (300, 100, 230, 70), (100, 60, 480, 320)]


@pytest.mark.parametrize(("profile", "budget_bps"), FLIGHTS)
def test_in_flight_it_is_full_prompt_and_better_than_the_video_with_every_method(scene, profile, budget_bps):
    """With the defaults on a thin link it would come after seconds, small and blurred, or be refused."""
    boxes = (dict(zip("xywh", box, strict=True)) for box in BOXES)
    looks = [RequestedLook(30 + 20 * number, box) for number, box in enumerate(boxes)]
    settings = {"source": str(scene), "max_frames": 90, "budget": budget_bps, "tiles": "off", **profile}
    _, summary = flown(looks, **settings)
    assert summary["worst_window_bps"]["total"] <= budget_bps
    bound_s = 1.5 if budget_bps >= 300_000 else 5.0
    for look, (_, _, width, height) in zip(looks, BOXES, strict=True):
        if look.header is None:
            assert "pixels take" in look.refusal
            assert width * height > 50_000, "only what is large is too large"
            continue
        assert look.delay_s <= bound_s
        if said := re.search(r"within about ([\d.]+) s", look.note):
            assert look.delay_s + 8 * look.size_bytes / budget_bps <= float(said[1]) + 0.2, "said in advance"
        assert look.image.shape[:2] == (height, width) or look.note
        image = cv2.resize(look.image, (width, height), interpolation=cv2.INTER_CUBIC)
        assert psnr_y_db(image, look.source) > psnr_y_db(look.base, look.source)
    assert all(one.header is not None and "w" not in one.header.parameters for one in looks[:2])
    assert summary["frame_account"]["closer_look"] > 0 or budget_bps >= 2_000_000


def test_an_edge_that_ends_says_so_to_whoever_waits(tmp_path):
    """Whoever asked at the end would be told of a full budget, and ask for more of it."""
    write_scene(tmp_path, frames=20)
    looks = [RequestedLook(19, {"x": 100, "y": 60, "w": 480, "h": 320})]
    flight, _ = flown(looks, source=str(tmp_path), budget=100_000, method="M0", fps="auto")
    number = looks[0].answer.still_request
    assert flight.command("still-outcome", ask=number).reason == "the edge has ended"
    assert flight.command("still").reason == "the edge has ended"
