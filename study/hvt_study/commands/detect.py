"""``hvt-study detect``: how good a detector is on pictures, in figures and in sheets to look at."""

import argparse
import csv
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hvt_common.errors import UserError, check_not_read
from hvt_common.inference.class_names import kind_of
from hvt_common.inference.detect import Detector, open_detector
from hvt_common.inference.heads import HEAD_NAMES
from hvt_common.inference.labels import default_confidence
from hvt_common.inference.store import EMBEDDED_DETECTOR
from hvt_common.inference.tiles import tiled
from hvt_common.runtime.reporting import write_json
from hvt_common.units import parse_size
from hvt_common.values import Detections, Image, View
from hvt_edge.source.resample import Resizer
from hvt_study.commands.arguments import check_whole, names_of, option
from hvt_study.commands.output import ONE_TARGET, RunProgress, check_out, decimals, print_columns, writing
from hvt_study.datasets.class_map import VEHICLE, VEHICLES
from hvt_study.datasets.label_files import read_image
from hvt_study.datasets.labelled_pictures import LabelledPicture, doubts_of, find_pictures
from hvt_study.datasets.labels import FrameLabels, inside_frame
from hvt_study.metrics.detection import detection_score
from hvt_study.metrics.judged import FrameView, Judged, judged
from hvt_study.metrics.picture_score import (
    above,
    along_line,
    as_one,
    calibration_error,
    chance_error,
    fitted_line,
    picture_score,
    right_boxes,
    sure_and_right,
)

_CELL_PX, _TEXT_PX = 150, 18
_CELL_SHAPE = (_CELL_PX + _TEXT_PX, _CELL_PX, 3)
_CELLS_ACROSS, _CELLS_DOWN = 8, 5
_CONTEXT = 2.5
"""Sides of the crop, in longer sides of the box."""
_LEAST_CROP_PX = 48
_RED = (60, 60, 255)


@dataclass(frozen=True, slots=True)
class Finding:
    """One box of a picture, x1 y1 x2 y2 in its pixels; ``weight`` orders, the largest first."""

    picture: LabelledPicture
    box_px: Sequence[float]
    text: str
    weight: float


def write_sheet(path: Path, findings: Sequence[Finding]) -> None:
    """Write a PNG of at most 40 crops; an earlier one is removed where there is nothing to show.

    Raises `OSError` where it cannot be written.
    """
    worst = sorted(findings, key=lambda one: -one.weight)[: _CELLS_ACROSS * _CELLS_DOWN]
    if not worst:
        path.unlink(missing_ok=True)
        return
    read = lru_cache(maxsize=1)(read_image)
    cells = np.zeros((-(-len(worst) // _CELLS_ACROSS) * _CELLS_ACROSS, *_CELL_SHAPE), np.uint8)
    # Those of one picture one after the other: each is opened once.
    for place in sorted(range(len(worst)), key=lambda place: worst[place].picture.path):
        picture = worst[place].picture
        image = read(picture.path, picture.labelled_size)
        assert image is not None, "it was detected on"
        cells[place] = _cell(worst[place], image)
    rows = [
        np.hstack([*cells[start : start + _CELLS_ACROSS]]) for start in range(0, len(cells), _CELLS_ACROSS)
    ]
    path.write_bytes(cv2.imencode(".png", np.vstack(rows))[1].tobytes())


def _cell(finding: Finding, image: Image) -> Image:
    x1, y1, x2, y2 = finding.box_px
    reach = max(_LEAST_CROP_PX, _CONTEXT * max(x2 - x1, y2 - y1))
    scale = _CELL_PX / reach
    left, top = (x1 + x2 - reach) / 2, (y1 + y2 - reach) / 2
    place = np.array([[scale, 0, -left * scale], [0, scale, -top * scale]])
    cell = np.asarray(cv2.warpAffine(image, place, (_CELL_PX, _CELL_PX), flags=cv2.INTER_LINEAR), np.uint8)
    corners = [(round((x - left) * scale), round((y - top) * scale)) for x, y in ((x1, y1), (x2, y2))]
    cv2.rectangle(cell, corners[0], corners[1], _RED, 1)
    strip = np.zeros((_TEXT_PX, _CELL_PX, 3), np.uint8)
    cv2.putText(strip, finding.text, (3, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA)
    return np.vstack((cell, strip))


_LEAST_CONFIDENCE = 0.01
"""Average precision needs the whole curve."""
_COLUMNS = ("file", "x1", "y1", "x2", "y2", "confidence", "class")
_Word = Callable[[str], str]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Pictures, the detector, and the classes that labels leave out."""
    parser.add_argument(
        "pictures",
        nargs="+",
        type=Path,
        metavar="PICTURES",
        help="pictures, folders of them, labelled sets (YOLO, Pascal VOC, VisDrone, COCO's JSON), "
        "or a MOTChallenge sequence (img1/, gt/gt.txt)",
    )
    option(parser, "--out")
    option(parser, "--detector", default=EMBEDDED_DETECTOR, help="as of hvt-edge")
    add = parser.add_argument
    add("--head", metavar="NAME", help=f"what its outputs mean, as of hvt-edge: {', '.join(HEAD_NAMES)}")
    add("--labels", type=Path, metavar="FILE", help="class names of the detector, as of hvt-edge")
    option(parser, "--size", help="what the detector is given: pictures are fitted into it")
    add("--tiles", default="off", help="as of hvt-edge: off, auto or CxR")
    least = "least confidence of what is written and counted (default: the detector's own, else 0.25)"
    add("--confidence", type=float, help=least)
    option(parser, "--classes")
    option(parser, "--labelled")
    add("--vehicles-as-one", action="store_true", help="car, van, truck and bus are one class")
    option(parser, "--provider", help="what runs the network, as of hvt-edge")
    add("--threads", type=int, default=2, help="of the network")


def run(arguments: argparse.Namespace) -> int:
    """Detect on all pictures; write detections.csv, and score.json and two sheets where there are labels."""
    with ExitStack() as written:
        return _detect(arguments, written)


def _detect(arguments: argparse.Namespace, written: ExitStack) -> int:
    size = parse_size(arguments.size, name="--size")
    confidence = arguments.confidence
    if confidence is None:
        confidence = default_confidence(arguments.detector)
    if not _LEAST_CONFIDENCE <= confidence <= 1:
        raise UserError(f"--confidence is {confidence}, must be from {_LEAST_CONFIDENCE} to 1")
    check_whole("--threads", arguments.threads, 1)
    names = names_of(arguments.classes)
    sets = {place: find_pictures(place, classes=names or None) for place in arguments.pictures}
    pictures = [one for of_set in sets.values() for one in of_set]
    detector = tiled(
        open_detector(
            arguments.detector,
            labels=arguments.labels,
            head=arguments.head,
            confidence=_LEAST_CONFIDENCE,
            threads=arguments.threads,
            provider=arguments.provider,
        ),
        arguments.tiles,
    )
    word: _Word = as_one if arguments.vehicles_as_one else kind_of
    classes = _counted(pictures, names_of(arguments.labelled), word)
    reads = [*arguments.pictures, *(one.path for one in pictures)]
    for name in ("detections.csv", "score.json", "false-alarms.png", "misses.png"):
        check_not_read(arguments.out / name, reads, name="--out")
        check_out(arguments.out, name=name)
    written.enter_context(writing(arguments.out))
    shown, frames, seen = [], [], 0
    with (arguments.out / "detections.csv").open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file)
        table.writerow(_COLUMNS)
        for picture, image, labels in readable(pictures, "pictures"):
            seen += 1
            view = detected(detector, image, size)
            table.writerows(_rows(picture.path, view, confidence))
            if labels is not None:
                shown.append(picture)
                frames.append((labels, view))
    if frames:
        recall_only = any(picture.one_target for picture in pictures)
        every = judged(frames, word=word, classes=classes)
        used = judged(above(frames, confidence), word=word, classes=classes)
        about = {
            "detector": arguments.detector,
            "confidence": confidence,
            "pictures": len(frames),
            "skipped": len(pictures) - seen,
            **picture_score(used, detection_score(every), recall_only=recall_only),
        }
        write_json(arguments.out / "score.json", about)
        found = zip(shown, used, strict=True)
        _write_sheets(arguments.out, found, classes=classes, recall_only=recall_only)
        print_score(about)
        if not recall_only:
            of_sets = (
                [frame for picture, frame in zip(shown, used, strict=True) if picture.path in known]
                for known in ({one.path for one in of_set} for of_set in sets.values())
            )
            _print_calibration(dict(zip(map(str, sets), of_sets, strict=True)), classes)
    print(f"{arguments.out}: {seen} pictures, {len(frames)} of them labelled")
    return 0 if seen else 2


def readable(
    pictures: Sequence[LabelledPicture], what: str
) -> Iterator[tuple[LabelledPicture, Image, FrameLabels | None]]:
    """Readable pictures with their labels; the others, and faults of labels, are named on stderr."""
    skipped = 0
    with RunProgress(what) as progress:
        for number, picture in enumerate(pictures, start=1):
            image = read_image(picture.path, picture.labelled_size)
            if image is None:
                skipped += 1
                print(f"{picture.unreadable}; skipped", file=sys.stderr)
            else:
                yield picture, image, picture.read((image.shape[1], image.shape[0]))
            progress.update(number, len(pictures))
    for sentence in doubts_of(pictures):
        print(sentence, file=sys.stderr)
    if skipped:
        print(f"{skipped} of {len(pictures)} pictures skipped", file=sys.stderr)


def detected(detector: Detector, image: Image, size: tuple[int, int]) -> FrameView:
    """The detector's boxes of a picture that is fitted into ``size``, in the picture's pixels."""
    source_size = (image.shape[1], image.shape[0])
    base = Resizer(source_size, size, fit="letterbox").frame(image, index=0, capture_ns=0).base_bgr
    found: Detections = detector.detect(base)
    boxes = View.fitted(source_size, size, fit="letterbox").to_source(found.boxes_xyxy_px)
    names = tuple(detector.class_names[kind] for kind in found.class_ids.tolist())
    return FrameView.plain(inside_frame(boxes, source_size), names, found.confidences)


def _rows(path: Path, view: FrameView, confidence: float) -> list[tuple[Any, ...]]:
    return [
        (path, *(round(side, 2) for side in box), round(sure, 4), name)
        for box, sure, name in zip(
            view.boxes_xyxy_px.tolist(), view.confidences.tolist(), view.class_names, strict=True
        )
        if sure >= confidence
    ]


def _counted(pictures: Sequence[LabelledPicture], labelled: Sequence[str], word: _Word) -> tuple[str, ...]:
    """The words that count: those of ``--labelled``, else every class that the labels may use."""
    known = sorted({name for picture in pictures for name in picture.class_names})
    names = labelled or known
    if labelled and VEHICLE in labelled:
        names = [*names, *VEHICLES]
    counted = {word(name) for name in names}
    if known and counted.isdisjoint(map(word, known)):
        raise UserError(f"--labelled {','.join(labelled)} is none of the labels' classes: {', '.join(known)}")
    return tuple(sorted(counted))


def _write_sheets(
    out: Path, found: Iterable[tuple[LabelledPicture, Judged]], *, classes: Sequence[str], recall_only: bool
) -> None:
    """The surest false alarms, where all objects are labelled, and the largest labels that were missed."""
    false, missed = [], []
    for picture, frame in found:
        labels, boxes = right_boxes(frame, classes=classes)
        view = frame.view
        for row in np.setdiff1d(np.arange(len(view)), boxes).tolist():
            sure = float(view.confidences[row])
            text = f"{view.class_names[row]} {sure:.2f}"
            false.append(Finding(picture, view.boxes_xyxy_px[row].tolist(), text, sure))
        for row in np.setdiff1d(np.arange(len(frame.class_names)), labels).tolist():
            box = frame.boxes_xyxy_px[row].tolist()
            missed.append(Finding(picture, box, frame.class_names[row], float(frame.areas_px2[row])))
    write_sheet(out / "false-alarms.png", [] if recall_only else false)
    write_sheet(out / "misses.png", missed)


def _print_calibration(sets: Mapping[str, Sequence[Judged]], classes: Sequence[str]) -> None:
    """The calibration error of each labelled set, as it is and with the line that makes the others' scores true."""
    found = {name: sure_and_right(frames, classes) for name, frames in sets.items()}
    found = {name: one for name, one in found.items() if len(one[0])}
    if len(found) < 2:  # nothing to fit on
        return
    rows = []
    for name, (sure, right) in found.items():
        others = [one for other, one in found.items() if other != name]
        line = fitted_line(*(np.concatenate(column) for column in zip(*others, strict=True)))
        fitted = calibration_error(along_line(sure, line), right)
        errors = calibration_error(sure, right), fitted, chance_error(sure)
        rows.append((Path(name).name, str(len(sure)), *map(decimals, errors)))
    heads = ("set", "boxes", "error", "fitted on the others", "by chance")
    print_columns("expected calibration error", heads, rows, words=("set",))


def print_score(score: dict[str, Any]) -> None:
    heads = ("", "labels", "boxes", "precision", "recall", "F1", "AP50")
    rows = (
        (
            *(name, str(one["labels"]), "-" if one["boxes"] is None else str(one["boxes"])),
            *(decimals(one[field]) for field in ("precision", "recall", "f1", "ap50")),
        )
        for name, one in [*score["by_class"].items(), ("all", score)]
    )
    title = f"{score['detector']} at confidence {score['confidence']:g}"
    print_columns(title, heads, rows, words=("",))
    error = score["calibration_error"]
    if "recall_only" in score:
        print(ONE_TARGET)
        return
    print("expected calibration error " + decimals(error))
