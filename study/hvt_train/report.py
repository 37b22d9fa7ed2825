"""The figures of ``docs/models.md``, printed."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from hvt_common.errors import UserError
from hvt_common.inference.classify import open_classifier
from hvt_common.inference.detect import open_detector
from hvt_common.inference.runtimes.model import ModelSettings, open_model
from hvt_train.evaluate import (
    CLEAN,
    clip_frames,
    drawn_pictures,
    evaluate_drawn,
    evaluate_real,
    reference_vehicles,
)
from hvt_train.pictures.crops import held_out_crops

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
    # Others on the machine lengthen the wall time; the CPU time of one thread is what the network itself costs.
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
            raise UserError(f"{path} does not exist; a file is expected")
    frames = list(clip_frames(clip, every=every))
    truth = reference_vehicles(reference, frames)
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
