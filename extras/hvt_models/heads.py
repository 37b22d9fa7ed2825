"""The heads of foreign exports, and the marks of each; see `hvt_common.inference.heads.choose`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np

from hvt_common.inference.heads.choose import (
    BGR_255,
    LEAST_COLUMNS,
    STRIDES,
    YOLOX,
    YOLOX_STRIDES,
    Kind,
    Match,
    Trial,
    anchor_count,
    are_probabilities,
    is_raw,
    of_cells,
    tables,
)
from hvt_common.inference.heads.contract import Array, rows_of
from hvt_common.inference.letterbox import Preparation
from hvt_models.exports.forms import MOST_RELATIVE, Corners, Dense, Listed, Parallel, PerQuery

_ANCHORS_A_CELL = 3
"""Anchors a cell of YOLOv5 and YOLOv7."""
_BOX = 4
_ADDS_UP = 1e-2
_PADDING = -1
_SCORE, _ANGLE = 0.05, 0.2
"""On a grey picture the mean over all cells of a class is below the one, that of an angle above the other."""

_RGB_1 = Preparation(mean=(0.0,) * 3, scale=(1 / 255,) * 3)
_RGB_255 = Preparation(mean=(0.0,) * 3, scale=(1.0,) * 3)


def _only(found: list[int]) -> int | None:
    return found[0] if len(found) == 1 else None


def _is_listed(trial: Trial, index: int) -> bool:
    # Whether the rows are objects: neither rows nor columns are cells.
    counts = [anchor_count(trial.size, strides) for strides in STRIDES]
    cells = {*counts, *(_ANCHORS_A_CELL * count for count in counts)}
    return cells.isdisjoint(trial.shape(index)[-2:])


def _named(trial: Trial, *words: str) -> tuple[int, ...]:
    # The one output whose name is, or has, each word, in their order; () where one has none, or several.
    names = [port.name.lower().partition(":")[0] for port in trial.ports]
    found = [
        [index for index, name in enumerate(names) if name == word]
        or [index for index, name in enumerate(names) if word in name]
        for word in words
    ]
    return tuple(one[0] for one in found) if all(len(one) == 1 for one in found) else ()


def _has_whole(trial: Trial, index: int) -> bool:
    # Whether an output has whole numbers by its type.
    dtype = trial.ports[index].dtype
    return dtype is not None and bool(np.issubdtype(dtype, np.integer))


def _has_angles(trial: Trial, index: int, first: int, *, transposed: bool = False) -> bool:
    # Whether the last column is no class as those from ``first`` on: on grey it alone has numbers.
    grey = trial.runs[0][index].astype(np.float32).reshape(trial.shape(index)[-2:])
    means = (grey.T if transposed else grey)[:, first:].mean(axis=0)
    return bool(len(means) > 1 and means[-1] > _ANGLE > _SCORE > means[:-1].max())


def _are_scores(numbers: Array) -> bool:
    # Whether they are probabilities, or -1 as behind the end of a list.
    return are_probabilities(numbers[numbers != _PADDING])


def _are_whole(numbers: Array) -> bool:
    # Whether all are whole numbers from -1 on, as classes are, and the padding behind them.
    return bool(
        np.isfinite(numbers).all()
        and (numbers >= -1.001).all()
        and (abs(numbers - numbers.round()) < 1e-3).all()
    )


# --- a row a cell ---------------------------------------------------------------------------------------------------


def _with_objectness(trial: Trial, *, constant: bool) -> Match | None:
    # (1, A, 5+C) in pixels; YOLOv6 has no objectness, and writes 1.
    for index, strides in of_cells(trial, YOLOX_STRIDES):
        classes, table = trial.shape(index)[2] - 5, trial.table(index)
        if classes < 1 or not are_probabilities(table[:, 4:]) or is_raw(trial, index, strides):
            continue
        if _has_angles(trial, index, 5):
            continue
        ones = bool((abs(table[:, 4] - 1) < 1e-3).all())
        if ones != constant:
            continue
        proof = None
        if ones:
            proof = "a row a cell in pixels, and column 5 is always 1"
        elif classes == trial.names:
            proof = f"a row a cell in pixels, objectness and {classes} scores, as many as there are names"
        return Match((index,), classes, Dense(objectness=True), proof)
    return None


def _yolov8_rows(trial: Trial) -> Match | None:
    for index, strides in of_cells(trial):
        classes, table = trial.shape(index)[2] - 4, trial.table(index)
        if not are_probabilities(table[:, 4:]) or is_raw(trial, index, strides):
            continue
        if _has_angles(trial, index, 4):
            continue
        same = classes == trial.names
        proof = f"a row a cell in pixels and {classes} scores, as many as there are names" if same else None
        return Match((index,), classes, Dense(), proof)
    return None


def _yolov5(trial: Trial) -> Match | None:
    for index, _ in of_cells(trial, times=_ANCHORS_A_CELL):
        classes, table = trial.shape(index)[2] - 5, trial.table(index)
        if classes >= 1 and are_probabilities(table[:, 4:]):
            decoder = Dense(objectness=True, one_class=classes == 1)
            return Match((index,), classes, decoder, "three rows a cell: box, objectness and scores")
    return None


def _yolov8(trial: Trial) -> Match | None:
    counts = [anchor_count(trial.size, strides) for strides in STRIDES]
    found = [
        index
        for index in tables(trial)
        for shape in [trial.shape(index)]
        if shape[2] in counts
        and shape[1] >= LEAST_COLUMNS
        and are_probabilities(_scores(trial, index))
        and not _has_angles(trial, index, 4, transposed=True)
    ]
    if not found or len({trial.shape(index) for index in found}) > 1:
        return None
    # YOLOv9 writes its auxiliary branch too: the main one is the surer of both.
    best = max(found, key=lambda index: float(_scores(trial, index).max(initial=0)))
    proof = "a column a cell: box and scores" + ("; of both branches the surer one" if len(found) > 1 else "")
    return Match((best,), trial.shape(best)[1] - 4, Dense(transposed=True), proof)


def _scores(trial: Trial, index: int) -> Array:
    return np.concatenate([run[index][0, 4:].astype(np.float32) for run in trial.runs], axis=1)


# --- a row an object ------------------------------------------------------------------------------------------------


def _end_to_end(trial: Trial) -> Match | None:
    index = _only(tables(trial, 6))
    if index is None or not _is_score_and_class(trial, index):
        return None
    proof = None
    table = trial.table(index)
    boxes = _shown(table)
    if _is_listed(trial, index) or len(boxes) < 0.5 * len(table):  # a row a cell has no padding
        if not len(boxes):
            proof = "rows of six; none in the trial, so as x1 y1 x2 y2 score class, which is usual"
        elif _are_corners(boxes):
            proof = "rows of six: x1 y1 x2 y2, a score and a class"
    return Match((index,), None, Listed(0, 4, 5), proof)


def _rt_detr_rows(trial: Trial) -> Match | None:
    # (1, N, 6) or (1, N, 4+C), boxes by their centre; as Ultralytics exports RT-DETR.
    index = _only([one for one in tables(trial) if trial.shape(one)[2] >= LEAST_COLUMNS])
    if index is None or not _is_listed(trial, index):
        return None
    table, columns = trial.table(index), trial.shape(index)[2]
    by_centre = _shows_centres(_shown(table))
    if columns == 6 and _is_score_and_class(trial, index):
        proof = "rows of six: a box by its centre, a score and a class" if by_centre else None
        return Match((index,), None, Listed(0, 4, 5, form="centre"), proof)
    if not are_probabilities(table[:, 4:]):
        return None
    proof = f"rows of a box by its centre and {columns - 4} scores" if by_centre else None
    return Match((index,), columns - 4, Dense(), proof)


def _with_image(trial: Trial, *, score: int, kind: int) -> Match | None:
    # (N, 7): image, x1 y1 x2 y2, and score and class in either order.
    index = _only([one for one in tables(trial, 7) if len(trial.shape(one)) == 2])
    if index is None:
        return None
    table = trial.table(index)
    proof = None
    if len(table):
        if not are_probabilities(table[:, score]) or not _are_whole(table[:, kind]):
            return None
        decided = not _are_whole(table[:, score]) or float(table[:, kind].max()) > 1
        order = "score, class" if score < kind else "class, score"
        proof = f"rows of seven: image, x1 y1 x2 y2, {order}" if decided else None
    return Match((index,), None, Listed(1, score, kind, image=0), proof)


def _ssd(trial: Trial) -> Match | None:
    found = [index for index in range(len(trial.ports)) if trial.shape(index)[:2] == (1, 1)]
    index = _only([one for one in found if len(trial.shape(one)) == 4 and trial.shape(one)[3] == 7])
    proof = "(1, 1, N, 7): image, class, score, x1 y1 x2 y2"
    return None if index is None else Match((index,), None, Listed(3, 2, 1, image=0), proof)


def _is_score_and_class(trial: Trial, index: int) -> bool:
    table = trial.table(index)
    return _are_scores(table[:, 4]) and _are_whole(table[:, 5])


def _shown(table: Array) -> Array:
    # (N, 4) boxes of the rows that are not padding.
    boxes = table[:, :4]
    return boxes[np.isfinite(boxes).all(axis=1) & (boxes > 0).any(axis=1)]


def _are_shares(boxes: Array) -> bool:
    # Whether there are boxes, and all are shares of the input.
    size = float(np.abs(boxes).max(initial=0))
    return 0 < size <= MOST_RELATIVE


def _are_corners(boxes: Array) -> bool:
    return bool((boxes[:, 2:] >= boxes[:, :2]).all() and (boxes[:, 2:] > boxes[:, :2]).any())


def _shows_centres(boxes: Array) -> bool:
    # Whether a centre, width and height are meant: shares of the input that cannot be corners.
    inside = float(np.abs(boxes).max(initial=0)) <= MOST_RELATIVE
    return bool(len(boxes) and inside and not _are_corners(boxes) and (boxes >= 0).all())


# --- boxes, scores and classes apart --------------------------------------------------------------------------------


def _boxes_and_table(trial: Trial) -> tuple[int, int] | None:
    # Outputs (1, N, 4) and (1, N, C); of several the last layer's, by DETR's names.
    found = tables(trial)
    pairs = [
        (boxes, scores)
        for boxes in found
        for scores in found
        if boxes != scores
        and trial.shape(boxes)[2] == _BOX
        and trial.shape(boxes)[1] == trial.shape(scores)[1]
    ]
    if len(pairs) > 1:  # four classes: the box is named so
        last = _named(trial, "pred_boxes", "pred_logits")
        names = [trial.ports[boxes].name.lower() for boxes, _ in pairs]
        boxed = [pair for pair, name in zip(pairs, names, strict=True) if "box" in name or "dets" in name]
        pairs = [pair for pair in boxed if pair == last] or boxed
    return pairs[0] if len(pairs) == 1 else None


def _yolo_nas(trial: Trial) -> Match | None:
    pair = _boxes_and_table(trial)
    if pair is None or not are_probabilities(trial.table(pair[1])):
        return None
    boxes = trial.table(pair[0])
    a_row_a_cell = not _is_listed(trial, pair[0]) and _are_corners(_shown(boxes)) and not _are_shares(boxes)
    proof = "boxes x1 y1 x2 y2 and scores, a row a cell" if a_row_a_cell else None
    scores_first = pair[1] < pair[0]  # DAMO-YOLO's, of pixels up to 255, and MMYOLO's
    return Match(
        pair,
        trial.shape(pair[1])[2],
        PerQuery("corners"),
        _if_pixels_are(trial, proof, usual=not scores_first),
    )


def _rt_detr(trial: Trial) -> Match | None:
    pair = _boxes_and_table(trial)
    if pair is None or not _is_listed(trial, pair[0]):
        return None
    boxes, table = trial.table(pair[0]), trial.table(pair[1])
    if not np.isfinite(table).all():
        return None
    logits = not are_probabilities(table)
    words = " ".join(trial.ports[index].name.lower() for index in pair)
    # Of a softmax over "no object" the greatest logit is positive everywhere, on grey too; and its scores add up.
    grey = rows_of(trial.runs[0][pair[1]].astype(np.float32))
    sure = grey.max(axis=1, initial=0) > 0 if logits else abs(table.sum(axis=1) - 1) < _ADDS_UP
    sigmoid = float(np.mean(sure)) < 0.5
    shown = _shown(boxes)
    said = (logits or "logit" in words) and not _are_corners(shown)
    decided = _are_shares(boxes) and (said or _shows_centres(shown))
    proof = f"boxes by their centre in 0…1 and {'logits' if logits else 'scores'}, a row a query"
    found = Match(
        pair,
        trial.shape(pair[1])[2],
        PerQuery("centre", logits=logits),
        proof if decided and sigmoid else None,
    )
    return None if "dets" in words else found  # RF-DETR, which wants other pixels


def _rf_detr(trial: Trial) -> Match | None:
    pair = _boxes_and_table(trial)
    if pair is None or _named(trial, "dets", "labels") != pair:
        return None
    proof = "outputs dets and labels" if _are_shares(trial.table(pair[0])) else None
    return Match(pair, trial.shape(pair[1])[2], PerQuery("centre", logits=True), proof)


def _nms_lists(trial: Trial) -> Match | None:
    count = _only(
        [i for i in range(len(trial.ports)) if np.prod(trial.shape(i)) == 1 and _has_whole(trial, i)]
    )
    lists = _lists(trial, leave=count)
    if count is None or lists is None or "detection_boxes" in trial.ports[lists[0]].name:
        return None
    proof = "a count, boxes, scores and classes" if _are_corners_or_none(trial, lists[0]) else None
    mmyolo = _named(trial, "num_dets", "boxes", "scores", "labels") == (count, *lists)  # RTMDet as YOLOv5
    return Match((*lists, count), None, Parallel(), _if_pixels_are(trial, proof, usual=not mmyolo))


def _labels_boxes_scores(trial: Trial) -> Match | None:
    lists = _lists(trial, leave=None) if len(trial.ports) == 3 else None
    if lists is None:
        return None
    said = "boxes, scores and classes (torchvision counts them from 1: its class 0 is the background)"
    proof = said if _are_corners_or_none(trial, lists[0]) else None
    # Those of SSD (ImageNet's means) and Custom Vision (0…255) are shares of the input, or called detected.
    others = _are_shares(trial.table(lists[0])) or "detected" in trial.ports[lists[0]].name.lower()
    return Match(lists, None, Parallel(), _if_pixels_are(trial, proof, usual=not others))


def _tf_lists(trial: Trial) -> Match | None:
    lists = _named(trial, "detection_boxes", "detection_scores", "detection_classes")
    count = _named(trial, "num_detections")
    if not lists or trial.shape(lists[0])[-1] != _BOX:
        return None
    proof = "outputs detection_boxes, detection_scores and detection_classes"
    return Match((*lists, *count), None, Parallel("corners-yx", first_class=1), proof, by_name=True)


def _atss(trial: Trial) -> Match | None:
    boxes = _only([*tables(trial, 5)])
    if boxes is None:
        return None
    kinds = _only([i for i in range(len(trial.ports)) if i != boxes and _has_whole(trial, i)])
    if kinds is None or np.prod(trial.shape(kinds)) != np.prod(trial.shape(boxes)[:-1]):
        return None
    table = trial.table(boxes)
    if not are_probabilities(table[:, 4]) or not _are_corners_or_none(trial, boxes):
        return None
    proof = "boxes with their score, and classes; pixels as the Open Model Zoo takes them, which hvt.mean overrules"
    mmdeploy = trial.ports[boxes].name == "dets"
    return Match((boxes, kinds), None, Corners(), _if_pixels_are(trial, proof, usual=not mmdeploy))


def _if_pixels_are(trial: Trial, proof: str | None, *, usual: bool) -> str | None:
    # No proof where networks with these very outputs take pixels in several ways, and the file does not say how.
    return proof if usual or "hvt.mean" in trial.metadata else None


def _numbers(trial: Trial, index: int) -> Array:
    # (N,) all numbers of an output of all pictures.
    return np.concatenate([run[index].astype(np.float32).ravel() for run in trial.runs])


def _lists(trial: Trial, *, leave: int | None) -> tuple[int, int, int] | None:
    # Outputs of boxes (…N, 4), scores (…N) and classes (…N); which is which is told by type, then by name.
    rest = [index for index in range(len(trial.ports)) if index != leave]
    boxes = _only([i for i in rest if len(trial.shape(i)) in (2, 3) and trial.shape(i)[-1] == _BOX])
    if boxes is None:
        return None
    long = [i for i in rest if i != boxes and trial.shape(i) == trial.shape(boxes)[:-1]]
    kinds = _only([i for i in long if _has_whole(trial, i)])
    if kinds is None:
        words = ("class", "label")
        kinds = _only([i for i in long if any(word in trial.ports[i].name.lower() for word in words)])
    scores = _only([i for i in long if i != kinds])
    if kinds is None or scores is None:
        return None
    fits = _are_scores(_numbers(trial, scores)) and _are_whole(_numbers(trial, kinds))
    return (boxes, scores, kinds) if fits else None


def _are_corners_or_none(trial: Trial, index: int) -> bool:
    boxes = _shown(trial.table(index))
    return not len(boxes) or _are_corners(boxes)


_letterboxed = partial(Kind, anchor="centre", preparation=_RGB_1)
_stretched = partial(Kind, anchor="stretch", preparation=_RGB_1, suppresses=False)

KINDS: Mapping[str, Kind] = {
    "yolox": YOLOX,
    "yolox-decoded": Kind(
        "YOLOX in pixels: (1, A, 5+C)", partial(_with_objectness, constant=False), "top-left", BGR_255
    ),
    "yolov5": _letterboxed("YOLOv5 and YOLOv7: (1, 3A, 5+C)", _yolov5),
    "yolov6": _letterboxed("YOLOv6: (1, A, 5+C), objectness 1", partial(_with_objectness, constant=True)),
    "yolov8": _letterboxed("YOLOv8 to v13, YOLOv5-u, YOLOv9: (1, 4+C, A)", _yolov8),
    "yolov8-rows": _letterboxed("the same, transposed: (1, A, 4+C)", _yolov8_rows),
    "end-to-end": _letterboxed(
        "YOLOv10, YOLO26, and NMS inside: (1, N, 6) x1 y1 x2 y2 score class", _end_to_end, suppresses=False
    ),
    "yolov7-rows": _letterboxed(
        "YOLOv7 with NMS: (N, 7) image x1 y1 x2 y2 class score",
        partial(_with_image, score=6, kind=5),
        suppresses=False,
    ),
    "yolo-nas": _letterboxed("YOLO-NAS: (1, A, 4) x1 y1 x2 y2 and (1, A, C)", _yolo_nas),
    "nas-rows": _letterboxed(
        "YOLO-NAS with NMS: (N, 7) image x1 y1 x2 y2 score class",
        partial(_with_image, score=5, kind=6),
        suppresses=False,
    ),
    "nms-lists": _letterboxed(
        "NMS of TensorRT, YOLO-NAS, YOLOv6: count (1, 1), boxes (1, N, 4), scores (1, N), classes (1, N)",
        _nms_lists,
        suppresses=False,
    ),
    "rt-detr": _stretched(
        "RT-DETR, D-FINE, DEIM: logits (1, N, C) and boxes (1, N, 4), centre x y w h 0…1", _rt_detr
    ),
    "rt-detr-rows": _stretched(
        "RT-DETR of Ultralytics: (1, N, 4+C) or (1, N, 6), centre x y w h", _rt_detr_rows
    ),
    "rf-detr": _stretched(
        "RF-DETR: dets (1, N, 4) and labels (1, N, C)", _rf_detr, preparation=Preparation.torchvision()
    ),
    "labels-boxes-scores": _stretched(
        "RT-DETR and D-FINE as deployed, torchvision: labels (N), boxes (N, 4) x1 y1 x2 y2, scores (N)",
        _labels_boxes_scores,
    ),
    "ssd": _stretched(
        "SSD of the Open Model Zoo: (1, 1, N, 7) image class score x1 y1 x2 y2", _ssd, preparation=BGR_255
    ),
    "atss": _stretched(
        "ATSS of the Open Model Zoo: boxes (N, 5) x1 y1 x2 y2 score, labels (N)", _atss, preparation=BGR_255
    ),
    "tf-lists": _stretched(
        "TensorFlow: detection_boxes (1, N, 4) y1 x1 y2 x2, _scores, _classes from 1",
        _tf_lists,
        preparation=_RGB_255,
    ),
}
"""The heads by the name of ``--head``, in the order of `HEAD_NAMES`."""
