"""Labels and views written as rows, for tests of metrics."""

from dataclasses import replace

import numpy as np

from hvt_common.config import load
from hvt_edge.config import EdgeConfig
from hvt_edge.config import check as check_edge
from hvt_ground.config import GroundConfig
from hvt_ground.config import check as check_ground
from hvt_study.datasets.labels import NO_ID, FrameLabels
from hvt_study.datasets.sequence import Clip
from hvt_study.flights.flight import FlightPlan
from hvt_study.metrics.classes import class_score
from hvt_study.metrics.judged import FrameView, judged


def square(x, y=0, side=10):
    """x1 y1 x2 y2 of a square."""
    return (x, y, x + side, y + side)


def labels(*rows, ignored=()):
    """Rows of (box, class) or (box, class, id)."""
    return FrameLabels(
        np.array([row[0] for row in rows], np.float32).reshape(-1, 4),
        np.array([row[2] if len(row) > 2 else NO_ID for row in rows], np.int64),
        tuple(row[1] for row in rows),
        np.array(ignored, np.float32).reshape(-1, 4),
    )


def view(*rows):
    """Rows of (box, class), with id, confidence and the class before refinement after it, each as far as given."""
    return FrameView(
        np.array([row[0] for row in rows], np.float32).reshape(-1, 4),
        np.array([row[2] if len(row) > 2 else place for place, row in enumerate(rows)], np.int64),
        tuple(row[1] for row in rows),
        np.array([row[3] if len(row) > 3 else 0.5 for row in rows], np.float32),
        tuple(row[4] if len(row) > 4 else row[1] for row in rows),
    )


def list_f1(report, frames, there):
    """F1 of a flight's list at some frames, where ``there(frame)`` gives (boxes, classes) that are really there."""
    pairs = []
    for frame in frames:
        boxes, names = there(frame)
        pairs.append((labels(*zip(boxes, names, strict=True)), report.lists[frame]))
    return class_score(judged(pairs)).f1


def clip_of(pictures, folder):
    """Pictures of one size as a clip whose pixels lie in that folder."""
    path = folder / "clip.bgr"
    path.write_bytes(np.stack(pictures).tobytes())
    return Clip("drawn", pictures[0].shape[1::-1], len(pictures), path)


def flight_plan(clip, *flags, link_bps=200_000):
    """A flight over a clip at its own size, in which the ground's detector looks at every frame."""
    usual = ("--source", "drawn", "--pace", "lockstep", "--size", "{}x{}".format(*clip.source_size))
    words = [*usual, "--budget", "200kbps", "--preset", "ultrafast", *flags]
    edge, _ = load(EdgeConfig, words, program="hvt-edge", description="")
    ground = check_ground(replace(GroundConfig(), classifier="detector", detect_every=1))
    return FlightPlan(clip, check_edge(edge), ground, link_bps)
