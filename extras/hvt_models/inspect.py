"""Describes a model file: its ports, the adapter that fits it, its classes, and its speed on this machine."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hvt_common.errors import UserError
from hvt_common.inference.classify import OnnxClassifier
from hvt_common.inference.detect import OnnxDetector
from hvt_common.inference.runtimes.model import ModelSettings, OnnxModel, open_model
from hvt_common.inference.runtimes.model_file import files_of, is_ir, opset_versions
from hvt_models.heads import KINDS

_ROUNDS = 9
_TIME_LIMIT_S = 3.0
_FREE_SIZE = (640, 384)
"""(width, height) at which a detector of any size is timed."""


@dataclass(frozen=True, slots=True)
class ModelReport:
    """The result of `inspect_model`."""

    model: OnnxModel
    size_bytes: int
    opsets: dict[str, int]
    adapter: str
    """detector, classifier or none."""
    because: str
    """The head and the preparation of pixels, or why no adapter fits."""
    class_names: tuple[str, ...]
    timing: str
    """The timed operation; empty if nothing was timed."""
    median_ms: float | None


def inspect_model(
    path: Path,
    *,
    provider: str = "cpu",
    threads: int = 1,
    head: str | None = None,
    labels: Path | None = None,
) -> ModelReport:
    """Open a model, try it as a detector and as a classifier, and time it; ``head`` and ``labels`` as of these.

    Raises `UserError` where it is no model, or not one that this provider opens, or of another head than is said.
    """
    model = open_model(path, settings=ModelSettings(threads=threads, provider=provider))
    adapter, because, class_names, once, timing = _fitted(model, head, labels)
    size_bytes = sum(file.stat().st_size for file in files_of(path))
    opsets = {} if is_ir(path) else opset_versions(path)
    median_ms = None if once is None else _median_ms(once)
    return ModelReport(model, size_bytes, opsets, adapter, because, class_names, timing, median_ms)


def _fitted(
    model: OnnxModel, head: str | None, labels: Path | None
) -> tuple[str, str, tuple[str, ...], Callable[[], object] | None, str]:
    noise = np.random.default_rng(0).integers(0, 256, (_FREE_SIZE[1], _FREE_SIZE[0], 3), dtype=np.uint8)
    refusals = []
    try:
        detector = OnnxDetector(model, head=head, labels=labels)
        width, height = detector.input_size(_FREE_SIZE)
        return (
            "detector",
            _detector_text(detector),
            detector.class_names,
            lambda: detector.detect(noise),
            f"one {_FREE_SIZE[0]}x{_FREE_SIZE[1]} image at a network input of {width}x{height}",
        )
    except UserError as error:
        if head is not None:
            raise
        refusals.append(_short(error))
    try:
        classifier = OnnxClassifier(model, labels=labels)
        return (
            "classifier",
            f"one row of scores a crop; {classifier.preparation} ({classifier.why}), stretched",
            classifier.class_names,
            lambda: classifier.classify([noise[:200, :200]]),
            "one crop",
        )
    except UserError as error:
        refusals.append(_short(error))
    return "none", "; ".join(refusals), (), None, ""


def _detector_text(detector: OnnxDetector) -> str:
    head = detector.head
    return f"head {head.name} ({KINDS[head.name].text}): {head.why}; {detector.pixels}"


def _short(error: UserError) -> str:
    # Without the ports and the accepted forms in brackets: the report shows the ports itself.
    return str(error).partition(": ")[2].partition(" (")[0] or str(error)


def _median_ms(once: Callable[[], object]) -> float:
    once()
    times: list[float] = []
    while len(times) < _ROUNDS and sum(times) < _TIME_LIMIT_S:
        start = time.perf_counter()
        once()
        times.append(time.perf_counter() - start)
    return statistics.median(times) * 1e3
