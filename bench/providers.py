"""The time of each execution provider, and its change of results: `python -m bench providers`.

Speed: median ms of the bare network, providers in turn on the same input, so that a busy machine slows all alike.
Change: on frames of the drone clip, F1 at IoU 0.5 with the same class, against the same network on cpu
(onnxruntime, float32). A provider that is faster may cost one point: F1 at least 0.99. The embedded detector has no
such bar: ``auto`` runs it on cpu, and docs/models.md has a table of the cost of others.
"""

import statistics
from pathlib import Path

import cv2
import numpy as np

from bench.bars import measured
from bench.support.material import data
from bench.support.processes import ms
from hvt_common.errors import UserError
from hvt_common.inference.detect import open_detector
from hvt_common.inference.runtimes.model import ModelSettings, open_model
from hvt_common.inference.runtimes.providers import PROVIDERS
from hvt_common.inference.store import embedded_models
from hvt_common.values import Detections, Image, iou

MODELS = (
    ("yolox_nano", (1, 3, 384, 640), 25),
    ("yolov5su_visdrone_640", (1, 3, 640, 640), 9),
    ("yolov5su_visdrone_736x1280", (1, 3, 736, 1280), 7),
)
CLASSIFIER = ("mobilenet_v2_imagenet", (1, 3, 224, 224), 25)
COMPARED = ("yolov5su_visdrone_736x1280", "yolov5su_visdrone_640")
EMBEDDED = "aerial-nano"
FRAMES = range(0, 351, 27)


def rows() -> list[dict]:
    providers = available()
    result = []
    for name, shape, rounds in (*MODELS, CLASSIFIER):
        times = _times(data() / f"models/{name}.onnx", shape, rounds, providers)
        size = f"{shape[3]}x{shape[2]}"
        result.append(measured("cpu, ms", times["cpu"][0], of=f"{name} {size}"))
        for provider in providers[1:]:
            ms, ratio = times[provider]
            result.append(measured(f"{provider}, ms", ms, of=f"{name} {size}"))
            result.append(measured("provider / cpu, time", ratio, of=f"{name} {size}, {provider}"))
    images = _frames()
    models = {name: str(data() / f"models/{name}.onnx") for name in COMPARED}
    models |= {name: name for name in embedded_models() if name == EMBEDDED}
    for name, spec in models.items():
        for provider in providers[1:]:
            row = "F1 against cpu" if name == EMBEDDED else "F1 of provider against cpu"
            result.append(measured(row, _f1(spec, images, provider), of=f"{name}, {provider}"))
    return result


def available() -> tuple[str, ...]:
    """cpu, then every other provider that runs the smallest model here."""
    found = ["cpu"]
    for provider in PROVIDERS:
        if provider not in ("cpu", "auto"):
            try:
                open_model(data() / "models/yolox_nano.onnx", settings=ModelSettings(provider=provider))
            except UserError:
                continue
            found.append(provider)
    return tuple(found)


def _times(
    path: Path, shape: tuple[int, ...], rounds: int, providers: tuple[str, ...]
) -> dict[str, tuple[float, float]]:
    """(median ms, median ratio to cpu) by provider."""
    models = {name: open_model(path, settings=ModelSettings(provider=name)) for name in providers}
    feed = np.random.default_rng(0).uniform(0, 1, shape).astype(np.float32)
    for model in models.values():
        for _ in range(3):
            model.run(feed)
    times = {name: [] for name in providers}
    for _ in range(rounds):
        for name, model in models.items():
            times[name].append(ms(lambda model=model: model.run(feed)))
    return {
        name: (
            statistics.median(times[name]),
            statistics.median(own / cpu for own, cpu in zip(times[name], times["cpu"], strict=True)),
        )
        for name in providers
    }


def _frames() -> list[Image]:
    clip = cv2.VideoCapture(str(data() / "clips/drone_carpark.mp4"))
    images = []
    for index in FRAMES:
        clip.set(cv2.CAP_PROP_POS_FRAMES, index)
        done, image = clip.read()
        if done:
            images.append(image)
    return images


def _f1(path: str, images: list[Image], provider: str) -> float:
    reference, other = (open_detector(path, provider=name) for name in ("cpu", provider))
    matched = total = 0
    for image in images:
        expected, found = reference.detect(image), other.detect(image)
        matched += _matches(expected, found)
        total += len(expected) + len(found)
    return 2 * matched / max(total, 1)


def _matches(expected: Detections, found: Detections) -> int:
    """Pairs of IoU 0.5 and one class, each box in one pair at most, the more confident first."""
    free = np.ones(len(expected), bool)
    count = 0
    for box, class_id in zip(found.boxes_xyxy_px, found.class_ids, strict=True):
        overlap = np.where(
            free & (expected.class_ids == class_id), iou(box[None], expected.boxes_xyxy_px)[0], 0
        )
        if overlap.size and overlap.max() >= 0.5:
            free[overlap.argmax()] = False
            count += 1
    return count
