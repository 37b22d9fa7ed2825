"""The pilot's four selectors, against a second implementation that follows the published table row by row."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_edge.stills.policy.paper import SELECTORS
from hvt_edge.stills.policy.registry import method
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


def selected(selector, *given) -> list[int]:
    return [index for index, *_ in selector.select(*given)]


def by_hand(name: str, boxes, confidences, names, area) -> list[int]:
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
    rows = [
        ((0, 0, 200, 200), 0.45, "car"),  # large
        ((0, 0, 30, 30), 0.90, "van"),
        ((50, 0, 80, 30), 0.55, "pedestrian"),
        ((0, 0, 11, 40), 0.60, "car"),  # too narrow for most
        ((90, 0, 120, 30), 0.42, "tricycle"),
        ((0, 300, 30, 330), 0.30, "car"),
        ((0, 400, 130, 505), 0.95, "bus"),  # 0.0148 of the frame: small everywhere
        ((0, 400, 130, 540), 0.51, "truck"),  # 0.0197: small for strict_small_only alone
    ]
    expected = {
        "permissive": [5, 4, 2],
        "conf_size_top1": [2],
        "strict_small_only": [7],
        "balanced_top2": [2, 1],
    }
    for name, indices in expected.items():
        assert selected(BY_NAME[name], *zip(*rows, strict=True), AREA) == indices


def test_what_is_not_small_is_fallen_back_to_and_ties_keep_the_order_of_detection():
    """The pilot's selector keeps one ROI a frame even where nothing is small; or each machine would keep another."""
    strict, permissive = BY_NAME["strict_small_only"], BY_NAME["permissive"]
    large = [(0, 0, 300, 300), (0, 0, 400, 300)]
    assert selected(strict, large, [0.9, 0.8], ["car", "car"], AREA) == [1]
    assert selected(permissive, [(0, 0, 30, 30)] * 5, [0.5] * 5, ["car"] * 5, AREA) == [0, 1, 2]
    assert selected(permissive, np.empty((0, 4)), np.empty(0), [], AREA) == []


def test_as_a_method_only_this_frame_s_detections_count():
    """A predicted box, of which no detector says that it is there, would be sent."""
    some = [
        candidate(track_id, (0.0, 0.0, side, side), frame_index=5, confidence=confidence, detected=detected)
        for track_id, confidence, side, detected in (
            (1, 0.9, 40.0, True),
            (2, 0.41, 40.0, False),
            (3, 0.6, 40.0, True),
            (4, 0.45, 200.0, True),
            (5, 0.95, 200.0, True),
        )
    ]
    wanted = method("balanced_top2").requests(some, decision_step(5))
    assert [(each.candidate.track_id, each.reason) for each in wanted] == [(3, "small"), (1, "small")]
    assert wanted[0].score == pytest.approx(2 * 0.4 + 1)
    alone = method("balanced_top2").requests([some[3]], decision_step(5))
    assert [each.reason for each in alone] == ["low confidence"]
