"""The detector without weights: patches that move over real and drawn ground, under a camera that moves too."""

from fractions import Fraction
from itertools import islice
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from hvt_models.detectors.motion import MotionDetector

CALLS = 18
SETTLED = 6  # calls after which the memory is full
VIEW = (960, 540)


def overlaps(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    low = np.maximum(first[:, None, :2], second[None, :, :2])
    high = np.minimum(first[:, None, 2:], second[None, :, 2:])
    shared = np.maximum(high - low, 0).prod(axis=2)
    areas = [(boxes[:, 2:] - boxes[:, :2]).prod(axis=1) for boxes in (first, second)]
    return shared / (areas[0][:, None] + areas[1][None] - shared)


def drawn_ground() -> np.ndarray:
    """Smooth noise of four sizes: texture everywhere."""
    rng, (height, width) = np.random.default_rng(3), (1160, 2136)
    ground = np.full((height, width, 3), 110, np.float32)
    for cell in (4, 12, 40, 120):
        noise = rng.normal(0, 18, (height // cell + 2, width // cell + 2, 3)).astype(np.float32)
        ground += cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(ground, 0, 255).astype(np.uint8)


def flight(
    ground: np.ndarray, *, seed: int, objects: int = 8, camera: float = 1.0, quality: int = 40
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Images and true boxes of patches that move 0.3 to 0.7 of their size a call; JPEG stands for coding noise.

    The camera pans 15 pixels, turns 0.3 degrees and zooms 0.4 % a call, times ``camera``.
    """
    rng = np.random.default_rng(seed)
    sides = rng.integers(14, 60, (objects, 2))
    start = rng.uniform((300, 200), (ground.shape[1] - 700, ground.shape[0] - 350), (objects, 2))
    angle = rng.uniform(0, 2 * np.pi, objects)
    speed = rng.uniform(0.3, 0.7, objects) * sides.mean(axis=1)
    velocity = np.stack([np.cos(angle), np.sin(angle)], axis=1) * speed[:, None]
    patches = [
        cv2.resize(rng.integers(0, 255, (4, 4, 3), dtype=np.uint8), tuple(map(int, side)), interpolation=0)
        for side in sides
    ]
    result = []
    for call in range(CALLS):
        world, boxes = ground.copy(), []
        for patch, place in zip(
            patches, np.rint(start + velocity * (call - CALLS / 2)).astype(int), strict=True
        ):
            (x, y), (h, w) = place, patch.shape[:2]
            if 0 <= x <= ground.shape[1] - w and 0 <= y <= ground.shape[0] - h:
                world[y : y + h, x : x + w] = patch
                boxes.append([[x, y], [x + w, y], [x + w, y + h], [x, y + h]])
        turn, zoom = np.deg2rad(0.3 * call * camera), 1.004 ** (call * camera)
        linear = zoom * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        view = np.column_stack([linear, [-200 - 14 * call * camera, -120 - 5 * call * camera]])
        image = cv2.warpAffine(world, view, VIEW)
        image = cv2.imdecode(
            cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_COLOR
        )
        corners = np.array(boxes, float).reshape(-1, 4, 2) @ linear.T + view[:, 2]
        truth = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)
        whole = (truth[:, :2] >= 0).all(axis=1) & (truth[:, 2:] <= VIEW).all(axis=1)
        result.append((image, truth[whole]))
    return result


def recall_and_precision(ground: np.ndarray) -> tuple[float, float]:
    """Over three flights, at IoU 0.5; objects cut by the border count neither way."""
    hits = wanted = right = found = 0
    for seed in (1, 2, 3):
        detector = MotionDetector()
        for call, (image, truth) in enumerate(flight(ground, seed=seed)):
            boxes = detector.detect(image).boxes_xyxy_px
            if call < SETTLED:
                continue
            boxes = boxes[(boxes[:, :2] > 1).all(axis=1) & (boxes[:, 2:] < np.array(VIEW) - 1).all(axis=1)]
            match = overlaps(truth, boxes) > 0.5
            hits, wanted = hits + match.any(axis=1).sum(), wanted + len(truth)
            right, found = right + match.any(axis=0).sum(), found + len(boxes)
    assert wanted > 100
    print(f"recall {hits / wanted:.3f} of {wanted}, precision {right / found:.3f} of {found}")
    return hits / wanted, right / found


def test_moving_patches_are_found_under_a_moving_camera() -> None:
    """The product would show nothing at all on a machine without a model."""
    recall, precision = recall_and_precision(drawn_ground())
    assert recall >= 0.85
    assert precision >= 0.85


@pytest.mark.realdata
def test_moving_patches_are_found_over_a_real_landscape(data: Path) -> None:
    """Trees and roads would light up as the drone flies over them."""
    picture = cv2.imread(str(data / "aerial_highway.jpg"))
    recall, precision = recall_and_precision(
        cv2.resize(picture, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    )
    assert recall >= 0.8
    assert precision >= 0.8


@pytest.mark.parametrize("camera", [0.0, 1.0, 2.0])
def test_a_scene_in_which_nothing_moves_is_empty(camera: float) -> None:
    """Stills would be spent on coding noise and on the camera's own motion."""
    detector = MotionDetector()
    found = [
        len(detector.detect(image))
        for image, _ in flight(drawn_ground(), seed=1, objects=0, camera=camera, quality=25)
    ]
    assert sum(found) <= 2


def test_confidence_grows_with_contrast_and_area() -> None:
    """The least visible specks would be the first to be sent."""

    def confidence(side: int, contrast: int) -> float:
        detector, best = MotionDetector(confidence=0), 0.0
        for call in range(8):
            image = np.full((240, 400, 3), 100, np.uint8)
            image[100 : 100 + side, 20 + 45 * call : 20 + 45 * call + side] = 100 + contrast
            found = detector.detect(image)
            best = float(found.confidences[0]) if len(found) else 0.0
        return best

    small, faint, plain = confidence(12, 60), confidence(36, 20), confidence(36, 60)
    assert 0 < small < plain < 1
    assert 0 < faint < plain


def test_what_stands_still_or_has_just_left_is_not_reported() -> None:
    """A parked car, and the empty place that a car has left, would count as traffic."""
    detector, frames = MotionDetector(), []
    for call in range(14):
        image = np.full((240, 400, 3), 90, np.uint8)
        image[20:60, 20:80] = 200
        x = 20 + max(0, call - 7) * 50
        image[150:180, x : x + 44] = 220
        frames.append((x, detector.detect(image).boxes_xyxy_px))
    assert all(len(boxes) == 0 for _, boxes in frames[:8])
    assert all(len(boxes) >= 1 for _, boxes in frames[8:])
    for x, boxes in frames[10:]:  # the first two calls cannot know that the place was left for good
        assert len(boxes) == 1
        assert overlaps(boxes, np.array([[x, 150, x + 44, 180]])).item() > 0.7


def test_a_cut_and_a_new_size_start_afresh() -> None:
    """The first frames after a cut would be one huge object, or a new resolution would crash."""
    rng, detector = np.random.default_rng(0), MotionDetector()
    scenes = [drawn_ground()[:360, :640], rng.integers(0, 255, (360, 640, 3), dtype=np.uint8)]
    for scene in (
        *scenes,
        drawn_ground()[:200, :300],
        np.zeros((1, 1, 3), np.uint8),
        np.zeros((30, 40), np.uint8),
    ):
        for _ in range(5):
            assert len(detector.detect(scene)) == 0
    detector.reset()
    assert len(detector.detect(scenes[0])) == 0


def test_large_images_give_boxes_in_their_own_pixels() -> None:
    """On a 4K camera every box would lie in the upper left corner."""
    detector = MotionDetector()
    for call in range(7):
        image = np.full((1440, 2560, 3), 80, np.uint8)
        image[900:1000, 100 + 250 * call : 300 + 250 * call] = 180
        found = detector.detect(image)
    assert overlaps(found.boxes_xyxy_px, np.array([[1600.0, 900, 1800, 1000]])).max() > 0.85


def test_the_same_images_give_the_same_detections() -> None:
    """A lockstep run could not be repeated."""
    images = [image for image, _ in flight(drawn_ground(), seed=5)][:9]
    first, second = MotionDetector(), MotionDetector()
    for image in images:
        one, other = first.detect(image), second.detect(image)
        np.testing.assert_array_equal(one.boxes_xyxy_px, other.boxes_xyxy_px)
        np.testing.assert_array_equal(one.confidences, other.confidences)


def coded(clip: Path, *, fps: int, frames: int, every: int) -> list[np.ndarray]:
    """Every n-th frame of the clip after x265 at 800 kbps and 1280 wide."""
    encoder = av.CodecContext.create("libx265", "w")
    encoder.pix_fmt, encoder.framerate, encoder.time_base = "yuv420p", fps, Fraction(1, fps)
    encoder.bit_rate = 800_000
    limits = "keyint=150:bframes=0:scenecut=0:vbv-maxrate=800:vbv-bufsize=160:log-level=none"
    encoder.options = {"preset": "ultrafast", "tune": "zerolatency", "x265-params": limits}
    decoder, result = av.CodecContext.create("hevc", "r"), []
    decoder.thread_type = "SLICE"
    with av.open(str(clip)) as container:
        video = container.streams.video[0]
        rate, height = float(video.average_rate), round(video.height * 1280 / video.width / 2) * 2
        encoder.width, encoder.height = 1280, height
        wanted = (
            f
            for k, f in enumerate(container.decode(video=0))
            if int(k * fps / rate) != int((k - 1) * fps / rate)
        )
        for index, frame in enumerate(islice(wanted, frames)):
            scaled = frame.reformat(1280, height, "yuv420p")
            scaled.pts, scaled.time_base, scaled.pict_type = index, encoder.time_base, 0
            for packet in encoder.encode(scaled):
                pictures = decoder.decode(av.Packet(bytes(packet)))
                result += [p.to_ndarray(format="bgr24") for p in pictures if index % every == 0]
    return result


@pytest.mark.realdata
def test_coded_real_frames_light_up_where_cars_drive_and_nowhere_else(data: Path) -> None:
    """At 0.8 Mbps coding noise would be sent as objects, or real cars would be missed."""
    detector = MotionDetector(confidence=0.5)
    images = coded(data / "clips/drone_carpark.mp4", fps=15, frames=66, every=5)
    found = [detector.detect(image) for image in images]
    counts = [len(detections) for detections in found[SETTLED:]]
    assert max(counts) <= 20  # 60 cars stand; three or four drive, some in parts, and a dozen people walk
    # Nothing moves in the right-hand column of parked cars.
    centres = np.concatenate([(d.boxes_xyxy_px[:, :2] + d.boxes_xyxy_px[:, 2:]) / 2 for d in found[SETTLED:]])
    parked = (centres[:, 0] > 1030) & (centres[:, 0] < 1160) & (centres[:, 1] > 215) & (centres[:, 1] < 775)
    assert not parked.any()
    # The white car in the lane at 4 s, with its shadow, as a person sees it.
    x, y, right, bottom = np.array([657, 306, 761, 381]) * (1280 / 1100)
    best = overlaps(found[12].boxes_xyxy_px, np.array([[x, y, right, bottom]]))
    print(counts, best.max())
    assert best.max() > 0.4
