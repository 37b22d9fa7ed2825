"""Milliseconds a frame of the tracker, and their ratio to roboflow's `trackers` where that is installed.

Run ``python -m bench.tracker``. `trackers` is no dependency of the project: install it into an environment of its
own and run this module with that Python and ``PYTHONPATH=common:.``.
"""

import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from bench.bars import measured
from hvt_common.tracking.bytetrack import ByteTracker
from hvt_common.values import Detections

COUNTS = (20, 50, 100, 500)
FRAMES = {20: 150, 50: 150, 100: 100, 500: 30}
ROUNDS = 5
FPS = 30.0


def scene(count: int, *, frames: int, seed: int = 7) -> list[Detections]:
    """Detections of ``count`` cars that drive about at constant density: jitter, misses, weak and false ones."""
    rng = np.random.default_rng(seed)
    side = 1280.0 * np.sqrt(count / 50)
    centre = rng.uniform(0, side, (count, 2))
    velocity = rng.normal(0, 3, (count, 2))
    size = rng.uniform(25, 60, (count, 2))
    result = []
    for _ in range(frames):
        centre = (centre + velocity) % side
        seen = rng.random(count) > 0.04
        false_count = rng.poisson(0.03 * count)
        boxes = np.concatenate((centre - size / 2, centre + size / 2), axis=1)[seen]
        boxes += rng.normal(0, 1.5, boxes.shape)
        corner = rng.uniform(0, side, (false_count, 2))
        boxes = np.concatenate((boxes, np.concatenate((corner, corner + 35), axis=1)))
        confidences = np.concatenate((rng.beta(8, 2, int(seen.sum())), rng.uniform(0.1, 0.7, false_count)))
        order = np.argsort(-confidences)
        result.append(
            Detections(
                boxes[order].astype(np.float32),
                confidences[order].astype(np.float32),
                np.zeros(len(order), np.int32),
            )
        )
    return result


def ours(detections: list[Detections]) -> float:
    """Seconds for all frames."""
    tracker = ByteTracker(fps=FPS)
    start = time.perf_counter()
    for index, seen in enumerate(detections):
        tracker.update(seen, frame_index=index)
    return time.perf_counter() - start


def roboflow() -> Callable[[list[Detections]], float] | None:
    """The same for roboflow's tracker with equal thresholds, or None where it is not installed."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import supervision  # noqa: PLC0415 - may be absent
            from trackers import ByteTrackTracker  # noqa: PLC0415
    except ImportError:
        return None

    def run(detections: list[Detections]) -> float:
        tracker = ByteTrackTracker(
            frame_rate=FPS,
            track_activation_threshold=0.6,
            high_conf_det_threshold=0.5,
            minimum_iou_threshold=0.2,
        )
        given = [
            supervision.Detections(
                xyxy=seen.boxes_xyxy_px, confidence=seen.confidences, class_id=seen.class_ids
            )
            for seen in detections
        ]
        start = time.perf_counter()
        for seen in given:
            tracker.update(seen)
        return time.perf_counter() - start

    return run


def rows() -> list[dict[str, Any]]:
    """One row a measurement: measure, value, bar, holds (None where there is no bar)."""
    theirs = roboflow()
    result: list[dict[str, Any]] = []
    for count in COUNTS:
        detections = scene(count, frames=FRAMES[count])
        own_ms, their_ms = [], []
        for _ in range(ROUNDS):  # in turns, and the best of each: other work on the machine only ever adds
            own_ms.append(ours(detections) / len(detections) * 1e3)
            if theirs is not None:
                their_ms.append(theirs(detections) / len(detections) * 1e3)
        result.append(measured(f"{count} boxes, ms a frame", round(min(own_ms), 3)))
        if their_ms:
            ratio = round(min(own_ms) / min(their_ms), 3)
            result.append(measured(f"{count} boxes, time / roboflow trackers", ratio))
    return result


if __name__ == "__main__":
    for one in rows():
        print(one)
