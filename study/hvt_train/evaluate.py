"""How good the embedded models are, on held-out drawn scenes and a real clip: the figures of ``docs/models.md``."""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError
from hvt_common.inference.classify import open_classifier
from hvt_common.inference.detect import Detector, open_detector
from hvt_common.inference.runtimes.model import ModelSettings, open_model
from hvt_common.values import Boxes, Detections, Image, iou
from hvt_edge.source.resample import Resizer
from hvt_scene.drawing.vehicles import CLASS_NAMES
from hvt_train.pictures.crops import held_out_crops
from hvt_train.pictures.places import Picture
from hvt_train.pictures.pool import BASE_SIZE, HELD_OUT_SEED, Shot, coded, shoot

CLEAN = 0
"""The bitrate that stands for frames that were not coded."""
_LEAST_VISIBLE = 0.3
_LEAST_SIDE_PX = 4.0
_VEHICLES = frozenset({"car", "van", "truck", "bus"})


@dataclass(frozen=True, slots=True)
class DrawnResult:
    """Average precision at IoU 0.5."""

    by_class: dict[str, float]
    objects: int

    @property
    def mean(self) -> float:
        """mAP@0.5 over the classes that occur."""
        return float(np.mean(list(self.by_class.values())))


@dataclass(frozen=True, slots=True)
class RealResult:
    """Agreement on vehicles with a reference detector, at IoU 0.5."""

    recall: float
    precision: float
    objects: int
    frames: int


def drawn_pictures(
    seeds: Sequence[int], *, moments: int, bitrates_bps: Sequence[int], coded_frames: int = 12
) -> dict[int, list[Picture]]:
    """Base pictures of held-out scenes by bitrate, every second one in the demo's own look; `CLEAN` is uncoded."""
    pictures: dict[int, list[Picture]] = {bitrate_bps: [] for bitrate_bps in bitrates_bps}
    lossy = [bitrate_bps for bitrate_bps in bitrates_bps if bitrate_bps != CLEAN]
    for seed in seeds:
        scene = shoot(HELD_OUT_SEED + seed, demo_appearance=seed % 2 == 0)
        for t_s in np.linspace(2.0, scene.duration_s - 1.0, moments):
            shot = Shot(scene, float(t_s))
            clean = shot.picture(BASE_SIZE)
            seen = dict(zip(lossy, coded(shot, bitrates_bps=lossy, frames=coded_frames), strict=True))
            for bitrate_bps, group in pictures.items():
                image = seen.get(bitrate_bps, clean.image_bgr)
                group.append(Picture(image, clean.boxes_px, clean.class_ids, clean.visible))
    return pictures


def evaluate_drawn(detector: Detector, pictures: Sequence[Picture]) -> DrawnResult:
    """mAP@0.5. An object less than 30 % visible or under 4 pixels counts neither for nor against.

    The detector should be opened with a very low confidence, so that the whole curve is there.
    """
    seen = [detector.detect(picture.image_bgr) for picture in pictures]
    by_class, count = {}, 0
    for kind, name in enumerate(CLASS_NAMES):
        if name not in detector.class_names:
            continue
        rows = [
            _matches(picture, found, kind, detector.class_names.index(name))
            for picture, found in zip(pictures, seen, strict=True)
        ]
        total = sum(row[2] for row in rows)
        count += total
        if total:
            scores, hits = (np.concatenate([row[i] for row in rows]) for i in (0, 1))
            by_class[name] = average_precision(scores, hits.astype(bool), total)
    return DrawnResult(by_class, count)


def well_visible(picture: Picture) -> npt.NDArray[np.bool_]:
    """(N,) which objects are asked for; the others count neither for nor against."""
    sides = (picture.boxes_px[:, 2:] - picture.boxes_px[:, :2]).max(1, initial=0)
    return np.asarray((picture.visible >= _LEAST_VISIBLE) & (sides >= _LEAST_SIDE_PX))


def _matches(
    picture: Picture, found: Detections, kind: int, kind_found: int
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_], int]:
    """Scores, hits and number of objects of one class in one picture; greedy, best first, each object once."""
    counts = well_visible(picture)
    wanted, ignored = picture.boxes_px[(picture.class_ids == kind) & counts], picture.boxes_px[~counts]
    rows = found.class_ids == kind_found
    boxes, scores = found.boxes_xyxy_px[rows], found.confidences[rows]
    hits = _hits(boxes, wanted)
    counted = hits | (_inside_share(boxes, ignored).max(1, initial=0) <= 0.5)
    return scores[counted], hits[counted], len(wanted)


def _hits(boxes: Boxes, wanted: Boxes) -> npt.NDArray[np.bool_]:
    """(N,) which boxes, best first, are on an object that none before them has taken."""
    table = iou(boxes, wanted)
    hits = np.zeros(len(boxes), np.bool_)
    for row in range(len(boxes) if len(wanted) else 0):
        best = int(table[row].argmax())
        if table[row, best] >= 0.5:
            hits[row], table[:, best] = True, 0
    return hits


def _inside_share(boxes: Boxes, others: Boxes) -> npt.NDArray[np.float32]:
    """(N, M) share of each box that lies in each of the others."""
    low, high = np.maximum(boxes[:, None, :2], others[:, :2]), np.minimum(boxes[:, None, 2:], others[:, 2:])
    area = (boxes[:, 2:] - boxes[:, :2]).prod(1)[:, None]
    return np.asarray((high - low).clip(0).prod(2) / np.maximum(area, 1e-9), np.float32)


def average_precision(scores: npt.NDArray[np.float32], hits: npt.NDArray[np.bool_], total: int) -> float:
    """Area under the precision envelope over recall, all points (VOC 2010 and later)."""
    order = np.argsort(-scores, kind="stable")
    found = np.cumsum(hits[order])
    recall = np.concatenate([[0.0], found / total, [1.0]])
    precision = np.concatenate([[1.0], found / np.arange(1, len(found) + 1), [0.0]])
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return float(((recall[1:] - recall[:-1]) * envelope[1:]).sum())


def clip_frames(clip: Path, *, every: int) -> Iterator[Image]:
    """Every n-th frame of a clip, whole in a 1280x720 picture as the base letterboxes it."""
    try:
        with av.open(str(clip)) as container:
            for index, frame in enumerate(container.decode(video=0)):
                if index % every == 0:
                    image = np.asarray(frame.to_ndarray(format="bgr24"), np.uint8)
                    fitted = Resizer((frame.width, frame.height), BASE_SIZE, fit="letterbox")
                    yield fitted.frame(image, index=index, capture_ns=0).base_bgr
    except (av.error.FFmpegError, IndexError) as error:
        raise UserError(f"{clip} is not a video that can be read ({error}); give another") from None


def reference_vehicles(reference: Path, frames: Sequence[Image], *, confidence: float = 0.4) -> list[Boxes]:
    """Boxes of vehicles that the reference model sees in each untouched frame."""
    detector = open_detector(str(reference), confidence=confidence)
    return [_vehicles(detector, frame) for frame in frames]


def _vehicles(detector: Detector, frame: Image) -> Boxes:
    found = detector.detect(frame)
    rows = [index for index, kind in enumerate(found.class_ids) if detector.class_names[kind] in _VEHICLES]
    return _one_each(found.boxes_xyxy_px[rows])


def _one_each(boxes: Boxes) -> Boxes:
    """Drop boxes that lie over a better one: to "vehicle or not", car and van on one spot are one vehicle."""
    chosen: list[int] = []
    table = iou(boxes, boxes)
    for row in range(len(boxes)):
        if not chosen or table[row, chosen].max() < 0.6:
            chosen.append(row)
    return boxes[chosen]


def evaluate_real(detector: Detector, frames: Sequence[Image], truth: Sequence[Boxes]) -> RealResult:
    """Recall and precision of vehicles of any kind at the confidence the detector was opened with."""
    hits = found = total = 0
    for frame, wanted in zip(frames, truth, strict=True):
        boxes = _vehicles(detector, frame)
        hits += int(_hits(boxes, wanted).sum())
        found, total = found + len(boxes), total + len(wanted)
    return RealResult(hits / max(total, 1), hits / found if found else math.nan, total, len(frames))


EVALUATION_FIRST = 200
"""First held-out scene of ``eval``; those from 0 on were looked at in development, 100 to 103 chose the weights."""

_SIZES = ((1280, 736), (640, 384))
_BITRATES = (CLEAN, 1_400_000, 800_000, 400_000)
_CONFIDENCES = (0.15, 0.25, 0.4)


def print_speed(detector: Path, *, size: tuple[int, int] = (640, 384), runs: int = 50) -> None:
    """Milliseconds of one image on one thread, of the processor and of the wall clock."""
    model = open_model(detector, settings=ModelSettings(threads=1))
    image = np.full((1, 3, size[1], size[0]), 114, np.float32)
    wall_ms, cpu_ms = [], []
    for _ in range(runs):
        wall, cpu = time.perf_counter(), time.process_time()
        model.run(image)
        wall_ms.append((time.perf_counter() - wall) * 1e3)
        cpu_ms.append((time.process_time() - cpu) * 1e3)
    # Others on the machine lengthen the wall time; the CPU time of one thread is that of the network itself.
    print(
        f"{detector.name} {size[0]}x{size[1]}, 1 thread: CPU median {np.median(cpu_ms):.1f} ms,"
        f" wall median {np.median(wall_ms):.1f} ms, least {min(wall_ms):.1f} ms"
    )


def print_drawn(detector: Path, classifier: Path, *, seeds: int, threads: int) -> None:
    """mAP@0.5 by input size and bitrate, and top-1 of the classifier on stills."""
    scenes = range(EVALUATION_FIRST, EVALUATION_FIRST + seeds)
    for bitrate_bps, pictures in drawn_pictures(scenes, moments=2, bitrates_bps=_BITRATES).items():
        for size in _SIZES:
            opened = open_detector(str(detector), confidence=0.01, size=size, threads=threads)
            result = evaluate_drawn(opened, pictures)
            each = " ".join(f"{name} {value:.3f}" for name, value in result.by_class.items())
            rate = "clean" if bitrate_bps == CLEAN else f"{bitrate_bps // 1000} kbps"
            print(
                f"{detector.name} input {size[0]}x{size[1]}, {rate}: mAP@0.5 {result.mean:.3f}"
                f" ({each}; {result.objects} objects in {len(pictures)} frames)",
                flush=True,
            )
    stills = list(held_out_crops(scenes, moments=2))
    posteriors = open_classifier(str(classifier), threads=threads).classify([image for image, _ in stills])
    hits = np.array([p.class_name == name for p, (_, name) in zip(posteriors, stills, strict=True)])
    names = np.array([name for _, name in stills])
    each = " ".join(f"{name} {hits[names == name].mean():.3f}" for name in sorted(set(names)))
    print(f"{classifier.name}: top-1 {hits.mean():.3f} of {len(hits)} stills at JPEG q65 ({each})")


def print_real(detector: Path, clip: Path, reference: Path, *, every: int) -> None:
    """Recall and precision of vehicles against the reference's boxes on the same untouched frames."""
    for path in (clip, reference):
        if not path.is_file():
            raise UserError(
                f"{path} {'is no file' if path.exists() else 'does not exist'}; a file is expected"
            )
    frames = list(clip_frames(clip, every=every))
    truth = reference_vehicles(reference, frames)
    if not any(map(len, truth)):
        raise UserError(f"{reference} sees no vehicle in {clip}: there is nothing to measure by")
    for size in _SIZES:
        for confidence in _CONFIDENCES:
            result = evaluate_real(
                open_detector(str(detector), confidence=confidence, size=size), frames, truth
            )
            print(
                f"{detector.name} input {size[0]}x{size[1]}, confidence {confidence}: recall@0.5 {result.recall:.3f},"
                f" precision {result.precision:.3f} ({result.objects} reference vehicles in {result.frames} frames)",
                flush=True,
            )
