"""The still stage: fits its admission, shows the box, and beats the base."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from hvt_common.protocol.messages import AlsoShown
from hvt_common.values import Frame, View
from hvt_common.video.base_crop import base_crop, coded_size
from hvt_common.video.hevc import BaseDecoder
from hvt_common.video.still_codecs import BaseMissingError, JpegCodec, still_codec
from hvt_common.video.still_codecs.jpeg import jpeg_size
from hvt_edge.link.stills import Still
from hvt_edge.perception.candidates import crop_box
from hvt_edge.stills.maker import NoStill, StillMaker
from hvt_edge.stills.policy.base import Request
from media.base_coded import Hopeless, StandIn
from media.clips import real_pictures
from media.recorded_feed import coded
from rigs.examples import candidate

SIZE = (1280, 720)
CODEC = JpegCodec()


def scene(width: int, height: int, *, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = np.full((height, width, 3), 110, np.float32)
    for cell in (4, 12, 48):
        noise = rng.normal(0, 18, (height // cell + 2, width // cell + 2, 3)).astype(np.float32)
        image += cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(image, 0, 255).astype(np.uint8)


def request_for(box, *, index: int = 0) -> Request:
    one = candidate(4, box, frame_index=index)
    return Request(one, "utility", 1.0)


def frame_of(source: np.ndarray, *, index: int = 0) -> Frame:
    return Frame(index=index, capture_ns=123, source_bgr=source, base_bgr=source)


def mse(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.mean((one.astype(np.float64) - other.astype(np.float64)) ** 2))


def luma(image: np.ndarray) -> np.ndarray:
    return image @ np.array([0.114, 0.587, 0.299])


def make(source, box, *, base=None, limit=100_000, maker=None, view=None, index=0):
    shape = (source.shape[1], source.shape[0])
    view = view or View.fitted(shape, SIZE, fit="letterbox")
    maker = maker or StillMaker()
    job = maker.crop(frame_of(source, index=index), request_for(box, index=index), view=view, base=base)
    return job if isinstance(job, NoStill) else maker.code(job, sequence=9, allowance=lambda _: limit)


@given(
    x=st.floats(-200, 1400),
    y=st.floats(-200, 900),
    w=st.floats(0, 900),
    h=st.floats(0, 900),
    padding=st.floats(0, 0.5),
    size=st.tuples(st.integers(4, 1300), st.integers(4, 800)),
)
@settings(max_examples=300)
def test_crop_box_is_inside_and_holds_the_box(x, y, w, h, padding, size):
    """A crop beyond the frame would crash the edge; one that cuts the object would mislead the classifier."""
    x1, y1, x2, y2 = crop_box((x, y, x + w, y + h), padding=padding, source_size=size)
    assert 0 <= x1 < x2 <= size[0]
    assert 0 <= y1 < y2 <= size[1]
    assert x2 - x1 >= min(8, size[0])
    assert y2 - y1 >= min(8, size[1])
    for low, high, start, end, limit in ((x, x + w, x1, x2, size[0]), (y, y + h, y1, y2, size[1])):
        if low < limit and high > 0:
            assert start <= max(0, low)
            assert end >= min(limit, high)


@pytest.mark.parametrize(
    ("box", "padding", "crop"),
    [
        ((100, 200, 200, 240), 0.15, (85, 194, 215, 246)),
        ((0, 0, 100, 40), 0.15, (0, 0, 115, 46)),
        ((1900, 1070, 1930, 1090), 0.0, (1900, 1070, 1920, 1080)),
        ((50, 50, 52, 52), 0.15, (47, 47, 55, 55)),
    ],
)
def test_crop_box_known_answers(box, padding, crop):
    """The padding would not be the pilot's 15 % on each side."""
    assert crop_box(box, padding=padding, source_size=(1920, 1080)) == crop


def test_a_still_says_what_it_shows():
    """The ground could not lay the still over its object."""
    source = scene(1920, 1080)
    still = make(source, (300.0, 200.0, 400.0, 260.0), index=17)
    assert isinstance(still, Still)
    shown = still.header
    assert (shown.sequence, shown.frame_index, shown.capture_ns, shown.track_id) == (9, 17, 123, 4)
    assert shown.crop_source_px == (285, 191, 415, 269)
    assert (shown.class_name, shown.reason, shown.codec, shown.quality_pct) == ("car", "utility", "jpeg", 65)
    assert jpeg_size(still.data) == (130, 78)
    crop = source[191:269, 285:415]
    assert still.data == CODEC.encode(np.ascontiguousarray(crop), quality_pct=65).data


@given(limit=st.integers(300, 8_000), side=st.integers(10, 150), seed=st.integers(0, 3))
# All sizes are near the limit, and dip: 44 % is found, and 58 % would fit.
@example(limit=321, side=10, seed=0)
@settings(max_examples=40)
def test_never_larger_than_admitted_and_the_best_that_fits(limit, side, seed):
    """The budget would be broken, or quality given away that was paid for."""
    source = scene(400, 300, seed=seed)
    box = (100.0, 80.0, 100.0 + side, 80.0 + side)
    made = make(source, box, limit=limit)
    x1, y1, x2, y2 = crop_box(box, padding=0.15, source_size=(400, 300))
    crop = np.ascontiguousarray(source[y1:y2, x1:x2])
    sizes = {quality: len(CODEC.encode(crop, quality_pct=quality).data) for quality in range(35, 66)}
    if isinstance(made, NoStill):
        assert made.reason == "too_large"
        assert sizes[35] > limit
    else:
        assert len(made.data) <= limit
        assert made.header.quality_pct == 65 or sizes[made.header.quality_pct + 1] > limit
        # Sizes may dip by a few bytes from one quality to the next, and the search miss what fits beyond such a dip.
        if list(sizes.values()) == sorted(sizes.values()):
            assert made.header.quality_pct == max(quality for quality, size in sizes.items() if size <= limit)


def test_long_crops_are_bounded():
    """A bus in a 4K picture would take a second of the link."""
    assert coded_size((0, 0, 1300, 650)) == (512, 256)
    assert coded_size((0, 0, 512, 300)) == (512, 300)
    source = scene(3840, 2160)
    still = make(source, (1000.0, 800.0, 1700.0, 1200.0), limit=10**6)
    assert isinstance(still, Still)
    width, height = jpeg_size(still.data)
    assert width == 512
    crop = still.header.crop_source_px
    assert height / width == pytest.approx((crop[3] - crop[1]) / (crop[2] - crop[0]), rel=0.01)


def test_no_still_that_is_coarser_than_the_base():
    """A large object would be sent with fewer pixels than the base already shows of it."""
    source = scene(1280, 720)
    poor = cv2.GaussianBlur(source, (0, 0), 4)
    assert make(source, (100.0, 50.0, 900.0, 650.0), base=poor, limit=10**6) == NoStill("base_good")
    assert isinstance(make(source, (100.0, 50.0, 400.0, 300.0), base=poor, limit=10**6), Still)


def test_quality_rises_until_the_base_is_beaten():
    """At a good base rate half of the stills would be worse than what the operator already sees."""
    source = scene(1280, 720)
    box = (300.0, 200.0, 420.0, 280.0)
    base_pictures = {quality: jpeg_coded(source, quality) for quality in (30, 72, 84)}
    made = {quality: make(source, box, base=base) for quality, base in base_pictures.items()}
    assert made[30].header.quality_pct == 65
    assert 72 < made[72].header.quality_pct < 84 < made[84].header.quality_pct <= 90
    assert make(source, box, base=source) == NoStill("base_good")
    assert make(source, box, base=base_pictures[72], limit=len(made[72].data) - 1) == NoStill("too_large")
    assert make(source, box, base=base_pictures[72], limit=len(made[72].data)) == made[72]


def test_the_base_gets_its_best_chance():
    """The base would be judged by a crop shifted by half a pixel, and stills sent that add nothing."""
    smooth = cv2.GaussianBlur(scene(1920, 1080), (0, 0), 3)
    for source_size, base_size in (
        ((1920, 1080), (1280, 720)),
        ((768, 432), (1280, 720)),
        ((1100, 720), (1280, 720)),
    ):
        source = cv2.resize(smooth, source_size, interpolation=cv2.INTER_AREA)
        view = View.fitted(source_size, base_size, fit="letterbox")
        base = np.zeros((base_size[1], base_size[0], 3), np.uint8)
        inner = (round(source_size[0] * view.scale), round(source_size[1] * view.scale))
        x, y = round(view.offset_px[0]), round(view.offset_px[1])
        base[y : y + inner[1], x : x + inner[0]] = cv2.resize(source, inner, interpolation=cv2.INTER_LINEAR)
        crop = (201, 103, 301, 163)
        seen = base_crop(base, view=view, crop_source_px=crop, size=(100, 60))
        truth = source[103:163, 201:301]
        error = mse(seen, truth)
        for shifted in (source[103:163, 202:302], source[104:164, 201:301]):
            assert error < 0.25 * mse(seen, shifted)
        assert error < 2.0


def flown(data, *, kbps: int) -> tuple[list[np.ndarray], list[np.ndarray], View, int]:
    sources = real_pictures(data / "clips" / "drone_carpark.mp4", 24, size=(1100, 720), step=1)
    left = (SIZE[0] - 1100) // 2
    padded = [cv2.copyMakeBorder(one, 0, 0, left, left, cv2.BORDER_CONSTANT) for one in sources]
    decoder = BaseDecoder()
    shown = [decoder.decode(unit) for unit, _ in coded(padded, kbps=kbps)]
    return sources, shown, View.fitted((1100, 720), SIZE, fit="letterbox"), left


@pytest.mark.realdata
@pytest.mark.parametrize(("kbps", "most"), [(400, 0.5), (800, 0.35)])
def test_stills_on_the_decoded_base_cost_a_part_and_show_as_much(data, kbps, most):
    """The codec that both sides need the base for would not be worth it, or not fit the ground's pictures."""
    sources, shown, view, _ = flown(data, kbps=kbps)
    residual, intra = still_codec("residual"), still_codec("h264-intra")
    built_maker = StillMaker(codec=residual, fallback=intra, fidelity_db=38.0)
    plain_maker = StillMaker(fidelity_db=38.0)
    built_bytes = plain_bytes = 0
    for row in range(4):
        for column in range(4):
            x, y = 60.0 + 240.3 * column, 40.0 + 160.7 * row
            box = (x, y, x + 92.0, y + 58.0)
            built = make(sources[20], box, base=shown[20], view=view, index=20, maker=built_maker)
            plain = make(sources[20], box, base=shown[20], view=view, index=20, maker=plain_maker)
            if isinstance(built, NoStill):
                assert isinstance(plain, NoStill)
                continue
            crop, base = built.header.crop_source_px, None
            size = (crop[2] - crop[0], crop[3] - crop[1])
            if built.header.codec == "residual":
                base = base_crop(shown[20], view=view, crop_source_px=crop, size=size)
            seen = still_codec(built.header.codec).decode(
                built.data, size=size, parameters=built.header.parameters, base_bgr=base
            )
            assert psnr_db(seen, crop_px(sources[20], built)) >= 38 - 1e-6
            built_bytes, plain_bytes = built_bytes + len(built.data), plain_bytes + len(plain.data)
    assert 0 < built_bytes < most * plain_bytes


@pytest.mark.realdata
@pytest.mark.parametrize(("kbps", "raised"), [(650, False), (1800, True)])
def test_every_still_is_closer_to_the_source_than_the_base(data, kbps, raised):
    """The operator would pay for a still that shows less than the video."""
    sources, shown, view, left = flown(data, kbps=kbps)
    stills, asked = [], 0
    for index in (8, 16, 23):
        for row in range(5):
            for column in range(7):
                # Car-sized boxes all over the car park.
                x, y = 40.0 + 148.3 * column, 25.0 + 131.7 * row
                box = (x, y, x + 92.0, y + (58.0 if row % 2 else 104.0))
                asked += 1
                made = make(sources[index], box, base=shown[index], limit=6_000, view=view, index=index)
                if isinstance(made, Still):
                    stills.append(made)
    assert len(stills) > 0.8 * asked
    for still in stills:
        assert len(still.data) <= 6_000
        x1, y1, x2, y2 = still.header.crop_source_px
        truth = sources[still.header.frame_index][y1:y2, x1:x2]
        base = shown[still.header.frame_index][y1:y2, x1 + left : x2 + left]
        sent = cv2.imdecode(np.frombuffer(still.data, np.uint8), cv2.IMREAD_COLOR)
        assert mse(sent, truth) < mse(base, truth)
        assert mse(luma(sent), luma(truth)) < mse(luma(base), luma(truth))
    assert any(still.header.quality_pct > 65 for still in stills) == raised


CAR = (300.0, 200.0, 420.0, 280.0)
BASE_CODED = StillMaker(codec=StandIn(), fallback=CODEC)


def blurred(source: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(source, (0, 0), 2)


def shown_of(still: Still, *, base: np.ndarray | None = None, view: View | None = None) -> np.ndarray:
    x1, y1, x2, y2 = still.header.crop_source_px
    size = (int(still.header.parameters.get("w", x2 - x1)), int(still.header.parameters.get("h", y2 - y1)))
    if still.header.codec == "jpeg":
        return CODEC.decode(still.data, size=size)
    view = view or View.fitted(SIZE, SIZE, fit="letterbox")
    seen = base_crop(base, view=view, crop_source_px=still.header.crop_source_px, size=size)
    return StandIn().decode(still.data, size=size, parameters=still.header.parameters, base_bgr=seen)


def crop_px(source: np.ndarray, still: Still) -> np.ndarray:
    x1, y1, x2, y2 = still.header.crop_source_px
    return source[y1:y2, x1:x2]


def jpeg_coded(source: np.ndarray, quality_pct: int) -> np.ndarray:
    _, data = cv2.imencode(".jpg", source, [cv2.IMWRITE_JPEG_QUALITY, quality_pct])
    return cv2.imdecode(data, cv2.IMREAD_COLOR)


def psnr_db(one: np.ndarray, other: np.ndarray) -> float:
    return 10 * np.log10(255**2 / max(1e-9, mse(luma(one), luma(other))))


def test_a_still_that_builds_on_the_base_says_so_and_can_be_undone():
    """The ground would have a still that it cannot show."""
    source = scene(*SIZE)
    base = blurred(source)
    still = make(source, CAR, base=base, maker=BASE_CODED)
    assert (still.header.codec, still.media_type) == ("stand-in", "image/webp")
    assert set(still.header.parameters) == {"c"}
    assert psnr_db(shown_of(still, base=base), crop_px(source, still)) > 30
    with pytest.raises(BaseMissingError):
        shown_of(still, base=np.roll(base, 1, axis=1))


def test_a_long_crop_says_its_coded_size_beside_the_codecs_own_parameters():
    """The ground would decode to the wrong size, or lose the reference to the base."""
    source = scene(3840, 2160)
    view = View.fitted((3840, 2160), SIZE, fit="letterbox")
    base = cv2.resize(blurred(source), SIZE, interpolation=cv2.INTER_AREA)
    still = make(source, (1000.0, 800.0, 1700.0, 1200.0), base=base, maker=BASE_CODED, limit=10**6)
    assert (still.header.parameters["w"], still.header.parameters["h"]) == (512, 293)
    assert "c" in still.header.parameters
    assert shown_of(still, base=base, view=view).shape == (293, 512, 3)


@pytest.mark.parametrize(
    ("read", "sent"),
    [
        ("residual h264-intra jpeg", ("residual", "h264-intra")),
        ("residual jpeg", ("residual", "jpeg")),
        ("h264-intra jpeg", ("h264-intra",)),
        ("jpeg", ("jpeg",)),
    ],
)
def test_what_a_ground_does_not_read_is_not_sent(read, sent):
    """It would show no still, and all of their bits would be for nothing."""
    codecs = {"codec": still_codec("residual"), "fallback": still_codec("h264-intra")}
    assert StillMaker(**codecs, readable=read.split().__contains__).codec_names == sent


def test_without_a_base_frame_the_fallback_serves():
    """A still of a frame that was not coded could never be shown, or would never be sent."""
    still = make(scene(*SIZE), CAR, maker=BASE_CODED)
    assert (still.header.codec, still.media_type, still.header.parameters) == ("jpeg", "image/jpeg", {})


@pytest.mark.parametrize("fidelity_db", [0.0, 36.0])
def test_where_the_base_shows_something_else_the_fallback_is_smaller(fidelity_db):
    """An object that has just come into view would cost more bits than with no base at all."""
    source, elsewhere = scene(*SIZE), scene(*SIZE, seed=5)
    # The other is what it would have been: no fallback ever beats a still of the same codec in size.
    chosen, built = (
        make(
            source,
            CAR,
            base=elsewhere,
            maker=StillMaker(codec=StandIn(), fallback=fallback, fidelity_db=fidelity_db),
        )
        for fallback in (CODEC, Hopeless())
    )
    assert chosen.header.codec == "jpeg"
    assert len(chosen.data) < len(built.data)
    crop = crop_px(source, chosen)
    assert psnr_db(shown_of(chosen), crop) >= psnr_db(shown_of(built, base=elsewhere), crop) - 1e-6


def test_fidelity_that_does_not_fit_gives_the_best_that_does():
    """Where room is short nothing at all would be seen sharp."""
    source = scene(*SIZE)
    base = blurred(source)
    maker = StillMaker(codec=StandIn(), fallback=CODEC, fidelity_db=40.0)
    whole = make(source, CAR, base=base, maker=maker)
    assert 40 <= psnr_db(shown_of(whole, base=base), crop_px(source, whole)) < 41
    tight = make(source, CAR, base=base, maker=maker, limit=len(whole.data) * 2 // 3)
    assert len(tight.data) <= len(whole.data) * 2 // 3
    crop = crop_px(source, tight)
    assert psnr_db(base[185:295, 279:441][: crop.shape[0], : crop.shape[1]], crop) < psnr_db(
        shown_of(tight, base=base), crop
    )
    assert tight.header.quality_pct < whole.header.quality_pct


def test_parameters_take_their_part_of_the_admission():
    """A still of just the room would overrun the window by what the codec writes into the header."""
    source = scene(*SIZE)
    base = blurred(source)
    view = View.fitted(SIZE, SIZE, fit="letterbox")
    job = BASE_CODED.crop(frame_of(source), request_for(CAR), view=view, base=base)
    whole = BASE_CODED.code(job, sequence=0, allowance=lambda _: 10**6)
    limit = len(whole.data) + 3

    def room(still: Still) -> int:
        return limit - 10 * len(still.header.parameters)

    still = BASE_CODED.code(job, sequence=0, allowance=room)
    assert len(still.data) <= limit - 10
    assert still.header.quality_pct < whole.header.quality_pct


def test_one_still_of_several_beats_the_base_at_each_of_them():
    """A neighbour that the base shows well would be shown worse by the still it shares."""
    source = scene(*SIZE)
    base = jpeg_coded(source, 75)  # better than a still of quality 65, but for one place
    base[200:280, 300:420] = blurred(source)[200:280, 300:420]
    lead = request_for(CAR)
    other = replace(request_for((440.0, 200.0, 560.0, 280.0)).candidate, track_id=7)
    both = replace(lead, also=(other,))
    view = View.fitted(SIZE, SIZE, fit="letterbox")
    job = StillMaker().crop(frame_of(source), both, view=view, base=base)
    still = StillMaker().code(job, sequence=0, allowance=lambda _: 10**6)
    assert still.header.also == (AlsoShown(track_id=7, box_source_px=other.box_source_px),)
    assert still.header.crop_source_px == (282, 188, 578, 292)
    shown = shown_of(still)
    for x1, x2 in ((300, 420), (440, 560)):
        truth = source[200:280, x1:x2]
        assert mse(shown[12:92, x1 - 282 : x2 - 282], truth) < mse(base[200:280, x1:x2], truth)


@pytest.mark.parametrize("fidelity_db", [0.0, 33.0, 36.0])
@pytest.mark.parametrize("limit", [50, 300, 399, 400, 1000, 100_000])
def test_a_still_too_small_to_change_anything_gets_more_bytes_or_waits_for_them(fidelity_db, limit):
    """Stills of 26 bytes would be sent, each with a header of a hundred, and show what the base shows."""
    source = scene(640, 360, seed=4)
    frame, box = frame_of(source), (100.0, 80.0, 190.0, 150.0)
    maker = StillMaker(
        codec=still_codec("residual"),
        fallback=still_codec("h264-intra"),
        fidelity_db=fidelity_db,
        least_bytes=400,
    )
    view = View.fitted((640, 360), (640, 360), fit="letterbox")
    base = cv2.blur(source, (15, 15))
    job = maker.crop(frame, request_for(box), view=view, base=base)
    assert not isinstance(job, NoStill)
    made = maker.code(job, sequence=0, allowance=lambda _still: limit)
    if limit < 400:
        assert made == NoStill("too_large")
    elif not isinstance(made, NoStill):
        assert 400 <= len(made.data) <= limit
    assert limit < 100_000 or isinstance(made, Still)
