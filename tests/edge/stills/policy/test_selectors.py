"""The pilot's four selectors, against a second implementation that follows the published table row by row."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_edge.stills.policy.registry import method
from hvt_edge.stills.policy.selectors import SELECTORS, select
from rigs.examples import candidate, decision_step

BY_NAME = {row.name: row for row in SELECTORS}
AREA = 1280 * 720
# The table of the pilot, written out once more.
TABLE = {
    "permissive": (0.20, 3, 0, None, 0.015),
    "conf_size_top1": (0.40, 1, 12, "car truck bus person", 0.015),
    "strict_small_only": (0.50, 1, 12, "car truck bus person", 0.020),
    "balanced_top2": (0.40, 2, 12, "car truck bus person", 0.015),
}
PILOT_WORD = {"car": "car", "van": "car", "truck": "truck", "bus": "bus"} | dict.fromkeys(
    ("person", "pedestrian", "people"), "person"
)
ORDER = {
    "permissive": lambda small, doubt: 2 * small + doubt,
    "conf_size_top1": lambda small, doubt: 2 * small + doubt,
    "strict_small_only": lambda small, doubt: 10 * small + 1e-6 * doubt,
    "balanced_top2": lambda small, doubt: 2 * doubt + small,
}


def selected(*given) -> list[int]:
    """The indices alone."""
    return [index for index, *_ in select(*given)]


def by_hand(name: str, boxes, confidences, names, area) -> list[int]:
    """The selection in plain loops."""
    least, top, side, classes, share = TABLE[name]
    rows = []
    for index, (box, confidence, word) in enumerate(zip(boxes, confidences, names, strict=True)):
        x1, y1, x2, y2 = (float(edge) for edge in box)
        if classes is not None and PILOT_WORD.get(word) not in classes.split():
            continue
        if x2 - x1 < side or y2 - y1 < side or float(confidence) < least:
            continue
        small = 1.0 if (x2 - x1) * (y2 - y1) / area < share else 0.0
        rows.append((-ORDER[name](small, 1 - float(confidence)), index))
    return [index for _, index in sorted(rows)[:top]]


detection = st.tuples(
    st.floats(0, 1200, width=32),
    st.floats(0, 700, width=32),
    st.one_of(st.floats(0, 300, width=32), st.sampled_from([11.0, 12.0, 13.0])),
    st.one_of(st.floats(0, 300, width=32), st.sampled_from([11.0, 12.0, 13.0])),
    st.one_of(st.floats(0.25, 1, width=32), st.sampled_from([0.25, 0.375, 0.5])),
    st.sampled_from(
        ["car", "van", "truck", "bus", "person", "pedestrian", "people", "bicycle", "motor", "tricycle"]
    ),
)


@pytest.mark.parametrize("name", BY_NAME)
@given(st.lists(detection, max_size=30))
@settings(max_examples=120, deadline=None)
def test_selectors_agree_with_the_table(name, rows):
    """The selector table of a user's clip would not be the pilot's."""
    boxes = np.array([(x, y, x + w, y + h) for x, y, w, h, _, _ in rows], np.float32).reshape(-1, 4)
    confidences = np.array([row[4] for row in rows], np.float32)
    names = [row[5] for row in rows]
    chosen = selected(BY_NAME[name], boxes, confidences, names, AREA)
    assert chosen == by_hand(name, boxes, confidences, names, AREA)


@pytest.mark.realdata
@pytest.mark.parametrize("word", ["person", "bicycle"])
def test_selectors_agree_on_real_detections(data, word):
    """On real boxes and confidences some ROI would differ from the pilot's."""
    results = json.loads((data / "tracking" / "palace" / "detections.json").read_text())["results"]
    frames: dict[str, list[dict]] = {}
    for row in results:
        frames.setdefault(row["frame_id"], []).append(row)
    area, picked = 1600 * 900, dict.fromkeys(BY_NAME, 0)
    for rows in frames.values():
        xywh = np.array(
            [[float(row[key]) for key in ("x", "y", "width", "height")] for row in rows], np.float32
        )
        boxes = np.concatenate([xywh[:, :2], xywh[:, :2] + xywh[:, 2:]], axis=1)
        confidences = np.array([float(row["prob"]) for row in rows], np.float32)
        for name, row in BY_NAME.items():
            chosen = selected(row, boxes, confidences, [word] * len(rows), area)
            assert chosen == by_hand(name, boxes, confidences, [word] * len(rows), area)
            picked[name] += len(chosen)
    assert len(frames) > 300
    assert picked["permissive"] > 300
    assert (picked["balanced_top2"] > 300) == (word == "person")


def test_known_answer():
    """The order by smallness and doubt would be turned round without anyone noticing."""
    boxes = np.array(
        [
            (0, 0, 200, 200),  # large, 0.45
            (0, 0, 30, 30),  # small, 0.90
            (50, 0, 80, 30),  # small, 0.55
            (0, 0, 11, 40),  # too narrow for most, 0.60
            (90, 0, 120, 30),  # small tricycle, 0.42
            (0, 300, 30, 330),  # small, 0.30
            (0, 400, 130, 505),  # 0.0148 of the frame: small everywhere, 0.95
            (0, 400, 130, 540),  # 0.0197: small for strict_small_only alone, 0.51
        ],
        np.float32,
    )
    confidences = np.array([0.45, 0.90, 0.55, 0.60, 0.42, 0.30, 0.95, 0.51], np.float32)
    names = ["car", "van", "pedestrian", "car", "tricycle", "car", "bus", "truck"]
    expected = {
        "permissive": [5, 4, 2],
        "conf_size_top1": [2],
        "strict_small_only": [7],
        "balanced_top2": [2, 1],
    }
    for name, indices in expected.items():
        assert selected(BY_NAME[name], boxes, confidences, names, AREA) == indices


def test_strict_small_only_falls_back_to_what_is_not_small():
    """The pilot's selector keeps one ROI a frame even where nothing is small; the name misleads."""
    boxes = np.array([(0, 0, 300, 300), (0, 0, 400, 300)], np.float32)
    chosen = selected(BY_NAME["strict_small_only"], boxes, np.array([0.9, 0.8]), ["car", "car"], AREA)
    assert chosen == [1]


def test_ties_keep_the_order_of_detection():
    """The same frame would give another ROI on another machine."""
    boxes = np.array([(0, 0, 30, 30)] * 5, np.float32)
    chosen = selected(BY_NAME["permissive"], boxes, np.full(5, 0.5), ["car"] * 5, AREA)
    assert chosen == [0, 1, 2]
    assert selected(BY_NAME["permissive"], np.empty((0, 4)), np.empty(0), [], AREA) == []


def test_as_a_method_only_this_frame_s_detections_count():
    """A predicted box, of which no detector says that it is there, would be sent."""
    moment = decision_step(5)

    def one(track_id, confidence, *, detected=True, side=40.0):
        box = (0.0, 0.0, side, side)
        share = side * side / AREA
        return candidate(
            track_id, box, frame_index=5, confidence=confidence, area_share=share, detected=detected
        )

    some = [
        one(1, 0.9),
        one(2, 0.41, detected=False),
        one(3, 0.6),
        one(4, 0.45, side=200.0),
        one(5, 0.95, side=200.0),
    ]
    wanted = method("balanced_top2").requests(some, moment)
    assert [(each.candidate.track_id, each.reason) for each in wanted] == [(3, "small"), (1, "small")]
    assert wanted[0].score == pytest.approx(2 * 0.4 + 1)
    alone = method("balanced_top2").requests([some[3]], moment)
    assert [each.reason for each in alone] == ["low confidence"]
