"""A session as the ground would hand it to the recorder: real x265 access units, boxes, stills, traffic."""

from collections.abc import Iterator, Sequence
from fractions import Fraction

import av
import cv2
import numpy as np

from hvt_ground.events import Event, Notice, Traffic, VideoSample
from rigs.examples import overlay, refinement

START_NS = 1_790_000_000_000_000_000
STEP_NS = 66_666_667


def drawn_frames(count: int, size: tuple[int, int] = (320, 192)) -> list[np.ndarray]:
    """A textured ground with a few rectangles that move across it."""
    rng = np.random.default_rng(3)
    ground = cv2.GaussianBlur(rng.integers(60, 180, (size[1], size[0], 3), np.uint8), (0, 0), 3)
    frames = []
    for i in range(count):
        frame = ground.copy()
        for k in range(3):
            corner = (10 + 60 * k + 2 * i % 80, 20 + 50 * k)
            cv2.rectangle(frame, corner, (corner[0] + 36, corner[1] + 20), (40 * k, 200, 255 - 60 * k), -1)
        frames.append(frame)
    return frames


def coded(frames: Sequence[np.ndarray], *, kbps: int, keyint: int = 150) -> list[tuple[bytes, bool]]:
    """(access unit, keyframe) of each frame, with the base stream's settings."""
    height, width = frames[0].shape[:2]
    encoder = av.CodecContext.create("libx265", "w")
    encoder.width, encoder.height, encoder.pix_fmt = width, height, "yuv420p"
    encoder.time_base, encoder.framerate = Fraction(1, 15), Fraction(15)
    encoder.bit_rate = kbps * 1000
    encoder.options = {
        "preset": "ultrafast",
        "tune": "zerolatency",
        "x265-params": f"keyint={keyint}:min-keyint=1:scenecut=0:bframes=0:rc-lookahead=0:repeat-headers=1:open-gop=0"
        f":vbv-maxrate={kbps}:vbv-bufsize={kbps // 5}:log-level=none",
    }
    packets = []
    for index, frame in enumerate(frames):
        picture = av.VideoFrame.from_ndarray(frame, format="bgr24").reformat(format="yuv420p")
        picture.pts = index
        packets += encoder.encode(picture)
    packets += encoder.encode(None)
    return [(bytes(packet), packet.is_keyframe) for packet in packets]


def moving_boxes(frame: int, count: int, size: tuple[int, int]) -> np.ndarray:
    """(count, 4) boxes on a grid, each drifting its own way, with a detector's jitter."""
    rng = np.random.default_rng(frame // 3)
    steady = np.random.default_rng(5)
    columns = int(np.ceil(np.sqrt(count)))
    grid = np.stack([np.arange(count) % columns, np.arange(count) // columns], 1) / columns
    corner = grid * (np.array(size) - 120) + steady.uniform(-0.3, 0.3, (count, 2)) * frame
    corner = corner + rng.normal(0, 0.4, (count, 2))
    extent = steady.uniform(30, 90, (count, 2)) + rng.normal(0, 0.4, (count, 2))
    return np.concatenate([corner, corner + extent], 1).astype(np.float32)


def session(
    frames: Sequence[np.ndarray], units: Sequence[tuple[bytes, bool]], *, tracks: int, total_kbps: float
) -> Iterator[tuple[Event, int]]:
    """(event, bytes it took on the link): stills fill what the base leaves of the budget, at most two a frame."""
    size = (frames[0].shape[1], frames[0].shape[0])
    classes = [("car", "van", "truck")[i % 3] for i in range(tracks)]
    refined: dict[int, tuple[str, float]] = {}
    received = sequence = 0
    for index, (frame, (data, keyframe)) in enumerate(zip(frames, units, strict=True)):
        capture_ns = START_NS + index * STEP_NS
        received += len(data)
        yield VideoSample(index, capture_ns, data, keyframe), len(data)
        boxes = moving_boxes(index, tracks, size)
        yield (
            overlay(
                index,
                boxes,
                capture_ns=capture_ns,
                base_classes=tuple(classes),
                classes=tuple(refined.get(i, (classes[i], 0.0))[0] for i in range(tracks)),
                confidences=np.array(
                    [refined.get(i, ("", 0.5 + index // 5 % 4 * 0.1))[1] for i in range(tracks)], np.float32
                ),
                refined=np.array([i in refined for i in range(tracks)]),
            ),
            0,
        )
        for _ in range(2):
            if index < 3 or received + 2000 > total_kbps * 125 * (index + 1) / 15:
                break
            chosen = sequence * 7 % tracks
            before = refined.get(chosen, (classes[chosen], 0.0))[0]
            after = before if sequence % 3 else "bus"
            refined[chosen] = (after, 0.9)
            still = _still(frame, boxes[chosen])
            received += len(still)
            crop = _inside(frame, boxes[chosen])
            yield (
                refinement(
                    frame_index=index,
                    capture_ns=capture_ns,
                    still_sequence=sequence,
                    track_id=chosen + 1,
                    edge_track_id=chosen + 100,
                    box_base_px=tuple(float(v) for v in boxes[chosen]),
                    still=still,
                    base_crop_bgr=cv2.GaussianBlur(crop, (0, 0), 1.5),
                    class_before=before,
                    class_after=after,
                    reason="small",
                ),
                len(still),
            )
            sequence += 1
        if index % 15 == 14:
            yield Traffic(index, capture_ns, 2e5, 9e4, 3e5, 3.1e5, 40.0, None, tracks, len(refined)), 0
    yield Notice(len(units) - 1, capture_ns, "warning", "edge gone"), 0


def _still(frame: np.ndarray, box: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", _inside(frame, box), [cv2.IMWRITE_JPEG_QUALITY, 65])[1].tobytes()


def _inside(frame: np.ndarray, box: np.ndarray) -> np.ndarray:
    """What of the box is in the frame, at least 8 pixels each way."""
    height, width = frame.shape[:2]
    x1, y1 = min(max(int(box[0]), 0), width - 9), min(max(int(box[1]), 0), height - 9)
    return frame[y1 : max(int(box[3]), y1 + 8), x1 : max(int(box[2]), x1 + 8)]
