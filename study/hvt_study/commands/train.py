"""``hvt-study train``: the embedded detector learns a user's own objects from his labelled pictures."""

import argparse
import math
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError, named_path, needs_extra
from hvt_common.inference.class_names import kind_of
from hvt_common.inference.detect import OnnxDetector, open_detector
from hvt_common.inference.runtimes.model import ModelSettings, open_model
from hvt_common.inference.store import EMBEDDED_DETECTOR, resolve_model
from hvt_common.runtime.reporting import check_writable, write_json
from hvt_common.units import parse_size
from hvt_common.values import Boxes, Image, View
from hvt_edge.source.resample import Resizer
from hvt_study.commands.arguments import names_of, option
from hvt_study.commands.detect import detected, readable
from hvt_study.commands.output import RunProgress, decimals, print_columns
from hvt_study.datasets.label_files import LOOKED_IN, read_image
from hvt_study.datasets.labelled_pictures import LabelledPicture, find_pictures
from hvt_study.datasets.labels import IGNORED, FrameLabels, inside_frame
from hvt_study.metrics.detection import detection_score
from hvt_study.metrics.judged import LabelledFrame, judged
from hvt_study.metrics.picture_score import above, picture_score

_INSTALL = "torch onnx"
_CURVE = 0.01
_USUAL_CONFIDENCE = 0.25
_HELD_OUT_SHARE, _MOST_HELD_OUT = 5, 120
_LEAST_PICTURES = 10
_SCHEMES = ("yolo", "coco")
_Size = tuple[int, int]


@dataclass(frozen=True, slots=True)
class _Own:
    """A picture that can be read, with its labels in its own pixels."""

    path: Path
    labels: FrameLabels
    labelled_size: tuple[int, int] | None = None

    def base(self, size: _Size) -> tuple[Image, FrameLabels]:
        """As the edge fits it into the base stream, with the labels there."""
        image = read_image(self.path, self.labelled_size)
        assert image is not None, "it was read before"
        source = (image.shape[1], image.shape[0])
        view = View.fitted(source, size, fit="letterbox")
        shown = Resizer(source, size, fit="letterbox").frame(image, index=0, capture_ns=0).base_bgr

        def there(boxes: Boxes) -> Boxes:
            return inside_frame(view.to_base(boxes), size)

        own = self.labels
        passed = there(own.passed_xyxy_px)
        return shown, FrameLabels.plain(there(own.boxes_xyxy_px), own.class_names, beside=passed)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Labelled pictures, where to begin, and for how long."""
    several = {"action": "append", "metavar": "yolo:FOLDER|coco:FILE.json"}
    data = "labelled pictures: images/, labels/ and classes.txt, or COCO's JSON; may be given several times"
    option(parser, "--data", **several, required=True, help=data)
    apart = "pictures to measure on in place of the last fifth of --data"
    option(parser, "--held-out", **several, default=[], help=apart)
    parser.add_argument(
        "--start", default=EMBEDDED_DETECTOR, metavar="NAME|FILE", help="network to begin with"
    )
    option(parser, "--out", metavar="FILE.onnx")
    option(parser, "--classes")
    option(parser, "--size", help="size of the base stream: pictures are fitted into it")
    parser.add_argument("--minutes", type=float, default=45.0, help="end the training after so many minutes")
    parser.add_argument("--steps", type=int, default=1500, help="most steps, of 8 views each")
    parser.add_argument("--seed", type=int, default=1, help="seed of everything that is random")
    parser.add_argument("--threads", type=int, default=2, help="threads of PyTorch")


def run(arguments: argparse.Namespace) -> int:
    """Read, train, measure; writes FILE.onnx, FILE.json (scores) and FILE.jsonl (the course of training)."""
    with needs_extra(_INSTALL):
        from hvt_train.fine_tune import FineTuneSettings, fill_own, fine_tune  # noqa: PLC0415 - PyTorch
        from hvt_train.pictures.places import Picture  # noqa: PLC0415
        from hvt_train.pictures.real import HeldOut  # noqa: PLC0415
    size, start = _checked(arguments)
    out: Path = arguments.out
    names = names_of(arguments.classes)
    data = [_labelled(uri, names) for uri in arguments.data]
    apart = [_labelled(uri, names) for uri in arguments.held_out]
    classes = _classes([picture for pictures in (*data, *apart) for picture in pictures])
    train, held_out = _split([_read(pictures) for pictures in data], [_read(pictures) for pictures in apart])
    _say(train, held_out, classes)

    def pictures() -> Iterator[Picture]:
        with RunProgress("pictures through x265") as progress:
            for number, own in enumerate(train, start=1):
                image, there = own.base(size)
                boxes, kinds = _rows(there, classes)
                yield Picture(image, boxes, kinds, np.ones(len(kinds), np.float32))
                progress.update(number, len(train))

    def held_out_base() -> Iterator[HeldOut]:
        for own in held_out:
            image, there = own.base(size)
            yield HeldOut(image, there.boxes_xyxy_px, there.passed_xyxy_px, frozenset(classes))

    before = _scored(start, held_out, size, classes, confidence=_confidence(start))
    # Beside FILE.onnx, for there is room; with a name that nobody has.
    with tempfile.TemporaryDirectory(prefix=f"{out.stem}-", dir=out.parent) as pool:
        files = fill_own(Path(pool), pictures(), seed=arguments.seed)
        with RunProgress("steps") as progress:

            def step(done: int, quality: float | None) -> None:
                progress.update(done, arguments.steps)
                if quality is not None:
                    progress.note(f"step {done}: AP50 {quality:.3f} on held-out pictures")

            tuned = fine_tune(
                files,
                held_out_base,
                classes=classes,
                start=start,
                out=out,
                settings=FineTuneSettings(
                    steps=arguments.steps,
                    budget_s=arguments.minutes * 60,
                    seed=arguments.seed,
                    threads=arguments.threads,
                ),
                measure=lambda path: _ap50(path, held_out, size, classes),
                on_step=step,
            )
    after = _scored(out, held_out, size, classes, confidence=_confidence(out))
    about = {
        "classes": classes,
        "trained_on": len(train),
        "held_out": len(held_out),
        "steps": tuned.steps,
        "best_step": tuned.best_step,
        "before": before,
        "after": after,
    }
    write_json(out.with_suffix(".json"), about)
    _print(about)
    if tuned.calibration is None:
        print("too few boxes on held-out pictures, or none wrong, to calibrate: scores are no probabilities")
    print(f"{out}: best of {tuned.steps} steps at {tuned.best_step}; fly with --detector {out}")
    return 0


def _checked(arguments: argparse.Namespace) -> tuple[_Size, Path]:
    """Size and start; `UserError` for impossible ones, before an hour is spent."""
    size = parse_size(arguments.size, name="--size")
    for name, value, most in (
        ("--minutes", arguments.minutes, 10_000),
        ("--steps", arguments.steps, 1_000_000),
        ("--threads", arguments.threads, 64),
    ):
        if not 0 < value <= most:
            raise UserError(f"{name} {value} is not accepted: more than 0, and {most} at most")
    if arguments.out.suffix != ".onnx":
        raise UserError(f"--out {arguments.out} is not accepted: give a file whose name ends with .onnx")
    if not arguments.out.parent.is_dir():
        raise UserError(f"--out {arguments.out} cannot be written: there is no folder {arguments.out.parent}")
    start = resolve_model(arguments.start, role="start")
    labels = [
        named_path(uri.partition(":")[2], name="--data") for uri in (*arguments.data, *arguments.held_out)
    ]
    for suffix in (".onnx", ".json", ".jsonl"):
        check_writable(arguments.out.with_suffix(suffix), name="--out", reads=[start, *labels])
    return size, start


def _labelled(uri: str, names: Sequence[str]) -> list[LabelledPicture]:
    """Pictures that somebody labelled; others are left out, and counted."""
    scheme, colon, text = uri.partition(":")
    place = named_path(text, name="--data")
    if not colon or scheme not in _SCHEMES:
        raise UserError(f"--data {uri} is not accepted: yolo:FOLDER or coco:FILE.json is")
    if scheme == "coco" and not place.is_file():
        raise UserError(f"--data {uri} is not a file: COCO's JSON is expected")
    found = find_pictures(place, classes=names or None)
    labelled = [picture for picture in found if picture.labels is not None]
    if not labelled:
        raise UserError(
            f"--data {uri} has {len(found)} pictures and no folder labels/, nor labels in {LOOKED_IN}"
        )
    if len(labelled) < len(found):
        left = len(found) - len(labelled)
        print(f"{left} pictures of {place} have no labels; left out", file=sys.stderr)
    return labelled


def _classes(pictures: Sequence[LabelledPicture]) -> list[str]:
    """In the order of classes.txt; of COCO's categories only those that occur."""
    found: dict[str, None] = {}
    for picture in pictures:
        used = None
        if isinstance(picture.labels, tuple):
            used = {str(row["name"]) for row in picture.labels}
        found |= dict.fromkeys(name for name in picture.class_names if used is None or name in used)
    names = [name for name in found if name and name.casefold() not in IGNORED]
    if not names:
        raise UserError("the labels name no class: there is nothing to learn")
    return names


def _read(pictures: Sequence[LabelledPicture]) -> list[_Own]:
    """Every picture and label once, so that faults are named at the start."""
    read = []
    for picture, _, labels in readable(pictures, "pictures read"):
        assert labels is not None, "only labelled ones are here"
        read.append(_Own(picture.path, labels, picture.labelled_size))
    return read


def _split(data: Sequence[list[_Own]], apart: Sequence[list[_Own]]) -> tuple[list[_Own], list[_Own]]:
    """Training and held-out pictures: the last fifth of each set is held out, for neighbours of a clip are alike.

    A picture that is in both is held out.
    """
    total = sum(map(len, (*data, *apart)))
    if total < _LEAST_PICTURES:
        raise UserError(
            f"--data has {total} labelled pictures that can be read: {_LEAST_PICTURES} are needed"
        )
    train, held_out = [], [own for pictures in apart for own in pictures]
    for pictures in data:
        last = 0 if apart else max(1, len(pictures) // _HELD_OUT_SHARE)
        train += pictures[: len(pictures) - last]
        held_out += pictures[len(pictures) - last :]
    measured = {own.path.resolve() for own in held_out}
    train = [own for own in train if own.path.resolve() not in measured]
    every = math.ceil(len(held_out) / _MOST_HELD_OUT)
    held_out = held_out[::every] if every else held_out
    for name, part in (("train on", train), ("hold out", held_out)):
        if not any(len(own.labels) for own in part):
            raise UserError(f"the pictures to {name} have no labelled object: label more, or hold out others")
    return train, held_out


def _say(train: Sequence[_Own], held_out: Sequence[_Own], classes: Sequence[str]) -> None:
    print(f"{len(train)} pictures to train on, {len(held_out)} held out")
    for name in classes:
        counts = [sum(own.labels.class_names.count(name) for own in part) for part in (train, held_out)]
        note = "" if all(counts) else "; it cannot be learnt" if not counts[0] else "; it cannot be measured"
        print(f"  {name}: {counts[0]} and {counts[1]} objects{note}")


def _rows(labels: FrameLabels, classes: Sequence[str]) -> tuple[Boxes, npt.NDArray[np.int32]]:
    """Boxes and class ids; -1 where the labels say that nothing counts."""
    kinds = [classes.index(name) for name in labels.class_names]
    passed = labels.passed_xyxy_px
    return np.concatenate([labels.boxes_xyxy_px, passed]), np.array([*kinds, *[-1] * len(passed)], np.int32)


def _frames(path: Path, held_out: Sequence[_Own], size: _Size) -> list[LabelledFrame]:
    detector = open_detector(str(path), confidence=_CURVE, provider="cpu")
    frames = []
    for own in held_out:
        image = read_image(own.path, own.labelled_size)
        assert image is not None, "it was read before"
        frames.append((own.labels, detected(detector, image, size)))
    return frames


def _ap50(path: Path, held_out: Sequence[_Own], size: _Size, classes: Sequence[str]) -> float:
    found = detection_score(judged(_frames(path, held_out, size), classes=classes)).mean.at_50
    return 0.0 if math.isnan(found) else found


def _scored(
    path: Path, held_out: Sequence[_Own], size: _Size, classes: Sequence[str], *, confidence: float
) -> dict[str, Any]:
    """The score over the classes that the network knows, by own names or by others of the same kind."""
    known = open_detector(str(path)).class_names
    words = {kind_of(name): name for name in reversed(classes)}

    def word(name: str) -> str:
        return name if name in classes else words.get(kind_of(name), name)

    shared = sorted({word(name) for name in known} & set(classes))
    if not shared:
        return {"confidence": confidence, "by_class": {}}
    frames = _frames(path, held_out, size)
    used = judged(above(frames, confidence), word=word, classes=shared)
    curve = detection_score(judged(frames, word=word, classes=shared))
    return {"confidence": confidence, **picture_score(used, curve)}


def _confidence(path: Path) -> float:
    """From where boxes are shown: the file's own threshold, else 0.25."""
    model = OnnxDetector(open_model(path, settings=ModelSettings(threads=1))).model
    return float(model.metadata.get("hvt.confidence", _USUAL_CONFIDENCE))


def _print(about: dict[str, Any]) -> None:
    fields = ("precision", "recall", "ap50")
    whens = ("before", "after")
    heads = [f"{when}: {field.replace('ap', 'AP')}" for when in whens for field in fields]
    rows = []
    for name in about["classes"]:
        pair = [about[when]["by_class"].get(name, {}) for when in whens]
        labels = str(pair[1].get("labels", 0))
        rows.append((name, labels, *(decimals(one.get(field)) for one in pair for field in fields)))
    title = f"on {about['held_out']} held-out pictures, by which the best step was chosen"
    print_columns(title, ("", "labels", *heads), rows, words=("",))
    error = about["after"].get("calibration_error")
    print(f"boxes are shown from confidence {about['after']['confidence']:g} on", end="")
    print("" if error is None else f"; expected calibration error {error:.3f}")
