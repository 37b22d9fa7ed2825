"""CLEAR MOT and IDF1 for tests: the study's own (`hvt_study.metrics.tracking`), for tracks by frame."""

import numpy as np

from hvt_study.metrics.tracking import TrackingScore, compare_tracks

Frames = dict[int, tuple[np.ndarray, np.ndarray]]
"""Frame index to ids (N,) and boxes x1 y1 x2 y2 (N, 4)."""


def score(truth: Frames, tracks: Frames, *, least_iou: float = 0.5) -> TrackingScore:
    """Compare tracks with the truth; boxes belong together from ``least_iou`` on."""
    nothing = np.empty(0, int), np.empty((0, 4))
    frames = sorted(truth.keys() | tracks.keys())
    return compare_tracks(
        [(truth.get(frame, nothing), tracks.get(frame, nothing)) for frame in frames], least_iou=least_iou
    )
