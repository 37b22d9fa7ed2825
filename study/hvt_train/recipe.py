"""The whole recipe: draw the pool, add real pictures, train, export, and leave logs and weights beside the files."""

from __future__ import annotations

import argparse
import copy
import datetime as dt
import subprocess
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import nn

from hvt_common.inference.classify import open_classifier
from hvt_common.inference.detect import open_detector
from hvt_common.inference.store import EMBEDDED_CLASSIFIER as CLASSIFIER
from hvt_common.inference.store import EMBEDDED_DETECTOR as DETECTOR
from hvt_common.inference.store import embedded_models
from hvt_common.values import Image
from hvt_scene.drawing.vehicles import CLASS_NAMES
from hvt_train.evaluate import CLEAN, drawn_pictures, evaluate_drawn, well_visible
from hvt_train.learning.calibration import fit_calibration, fit_temperature
from hvt_train.learning.classifier import ClassifierNet, export_classifier, train_classifier
from hvt_train.learning.detector import DetectorNet
from hvt_train.learning.export import metadata
from hvt_train.learning.loop import LoopSettings
from hvt_train.learning.train_detector import export_detector, train_detector
from hvt_train.pictures.camera import Teachers
from hvt_train.pictures.crops import (
    CropSource,
    held_out_crops,
    held_out_real_crops,
    pool_crops,
    real_crops,
    scene_crops,
)
from hvt_train.pictures.kinds import CLASSES
from hvt_train.pictures.pool import PoolPlan, fill_pool
from hvt_train.pictures.real import HeldOut, fill_real, held_out_pictures
from hvt_train.pictures.views import ViewSettings

_VALIDATION = range(100, 104)
"""Held-out scenes by which the best weights are chosen; ``eval`` measures on others."""

_SUMMARY = {
    DETECTOR: "Vehicles, people and boats seen from above or aslant, in daylight and thermal. Input BGR 0…255, free"
    " multiples of 32, letterboxed top-left with 114; output a raw YOLOX head.",
    CLASSIFIER: "Class of a 96x96 crop (padded by 15 %) of a vehicle or person; other is anything else.",
}
_CREDITS = (
    "Begun from YOLOX-nano's COCO weights (Megvii, Apache-2.0); drawn scenes of this project; KIT AIS (CC BY 3.0,"
    " labels by jekhor); HIT-UAV (Suo et al., Sci Data 2023, CC BY 4.0); CATS-Lab Madison drone-view vehicles, with"
    " our marks of people; clips of intel-iot-devkit/sample-videos (CC BY 4.0); SeaDronesSee (Varga et al., WACV"
    " 2022, CC0); drone pictures of Brighton Beach (Piero Toffanin, BSD-2-Clause) and Seneca (Ohio Department of"
    " Transportation, CC0); contains information from Traffic Images accessed March 2021 from data.gov.sg, made"
    " available under the terms of the Singapore Open Data Licence version 1.0"
)


def run_recipe(arguments: argparse.Namespace) -> None:
    """Train ``arguments.command`` (``detector``, ``classifier`` or ``all``) into ``arguments.out``."""
    cv2.setNumThreads(1)
    torch.set_num_threads(arguments.threads)
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    plan = PoolPlan(
        scenes=arguments.scenes, codes=arguments.codes, places=arguments.places, aslant=arguments.aslant
    )
    pool = fill_pool(out / "pool", plan, workers=arguments.workers)
    if arguments.real is not None:
        pool += fill_real(out / "pool", arguments.real, teachers=_teachers(arguments))
    if arguments.command in ("detector", "all"):
        _detector(arguments, pool)
    if arguments.command in ("classifier", "all"):
        _classifier(arguments, pool)


def _teachers(arguments: argparse.Namespace) -> Teachers | None:
    """``--teachers``: person-vehicle-bike-detection-2003 and YOLOX-nano; the embedded detector is the third."""
    if arguments.teachers is None:
        return None
    names = ("vehicle", "person", "bike")
    best, nano, own = (
        open_detector(str(one), confidence=0.08, threads=arguments.threads)
        for one in (*arguments.teachers, DETECTOR)
    )
    return Teachers(best, nano, own, names=names)


def _detector(arguments: argparse.Namespace, pool: list[Path]) -> None:
    groups = drawn_pictures(_VALIDATION, moments=1, bitrates_bps=(CLEAN, 800_000)).values()
    pictures = [picture for group in groups for picture in group]

    def measure(path: Path) -> float:
        return evaluate_drawn(
            open_detector(str(path), confidence=0.01, threads=arguments.threads), pictures
        ).mean

    best = _Best(arguments, DETECTOR, export_detector, measure)
    train_detector(
        pool,
        settings=LoopSettings(
            steps=arguments.steps,
            rate=arguments.rate,
            budget_s=_seconds(arguments),
            check_every=400,
            device="cuda" if torch.cuda.is_available() else "cpu",
        ),
        views=ViewSettings(side=416),
        seed=arguments.seed,
        batch=arguments.batch,
        workers=arguments.workers,
        log=arguments.out / f"{DETECTOR}.jsonl",
        check=best.check,
        start=_started(arguments, DETECTOR),
    )
    if arguments.real is not None:
        _calibrate(arguments)


def _calibrate(arguments: argparse.Namespace) -> None:
    """Export the best weights again, with scores that say how often a box is right on held-out pictures."""
    path = (arguments.out / DETECTOR).with_suffix(".onnx")
    net = DetectorNet(len(CLASSES))
    net.load_state_dict(torch.load(path.with_suffix(".pt")))
    detector = open_detector(str(path), confidence=0.02, threads=arguments.threads)
    drawn = drawn_pictures(_VALIDATION, moments=1, bitrates_bps=(CLEAN, 400_000)).values()
    scenes = (
        HeldOut(one.image_bgr, one.boxes_px[clear], one.boxes_px[~clear], frozenset(CLASSES))
        for group in drawn
        for one in group
        for clear in [well_visible(one)]
    )
    found = fit_calibration(detector, [*held_out_pictures(arguments.real), *scenes])
    properties = _properties(DETECTOR, arguments.seed) | {
        "hvt.calibration": f"{found.slope:.4f} {found.shift:.4f}",
        "hvt.confidence": f"{found.confidence:.2f}",
    }
    export_detector(net, path, properties=properties, calibration=found)


def _classifier(arguments: argparse.Namespace, pool: list[Path]) -> None:
    stills = list(held_out_crops(_VALIDATION, moments=1))
    crops, names = [crop for crop, _ in stills], [name for _, name in stills]

    def measure(path: Path) -> float:
        posteriors = open_classifier(str(path), threads=arguments.threads).classify(crops)
        return float(np.mean([p.class_name == name for p, name in zip(posteriors, names, strict=True)]))

    groups = [*pool_crops(pool, most=40), *scene_crops(range(arguments.crop_scenes), moments=4, most=60)]
    if arguments.real is not None:
        finds_too_much = open_detector(DETECTOR, confidence=0.12, threads=arguments.threads)
        groups += real_crops(pool, finds_too_much, most=8)
    train_classifier(
        CropSource(groups, seed=arguments.seed),
        settings=LoopSettings(
            steps=arguments.classifier_steps,
            rate=arguments.rate,
            budget_s=_seconds(arguments),
            check_every=500,
        ),
        seed=arguments.seed,
        batch=64,
        workers=arguments.workers,
        log=arguments.out / f"{CLASSIFIER}.jsonl",
        start=_started(arguments, CLASSIFIER),
        check=_Best(arguments, CLASSIFIER, export_classifier, measure).check,
    )
    if arguments.real is not None:
        _calibrate_classifier(arguments, stills)


def _calibrate_classifier(arguments: argparse.Namespace, drawn: list[tuple[Image, str]]) -> None:
    """Export the best weights again, with probabilities that are true on held-out stills, drawn and real."""
    path = (arguments.out / CLASSIFIER).with_suffix(".onnx")
    net = ClassifierNet(len(CLASS_NAMES))
    net.load_state_dict(torch.load(path.with_suffix(".pt")))
    finds_too_much = open_detector(DETECTOR, confidence=0.12, threads=arguments.threads)
    stills = [*drawn, *held_out_real_crops(arguments.real, finds_too_much)]
    temperature = fit_temperature(open_classifier(str(path), threads=arguments.threads), stills)
    properties = _properties(CLASSIFIER, arguments.seed) | {"hvt.calibration": f"{temperature:.4f}"}
    export_classifier(net.eval(), path, properties=properties, temperature=temperature)


def _started(arguments: argparse.Namespace, name: str) -> Path | None:
    """``embedded`` goes on from the file of the package, a folder from the one there; a file starts the detector."""
    if arguments.start is None:
        return None
    if Path(arguments.start).suffix == ".onnx":
        return Path(arguments.start) if name == DETECTOR else None
    return (
        embedded_models()[name] if arguments.start == "embedded" else Path(arguments.start) / f"{name}.onnx"
    )


class _Best:
    """Measures the file at every check on held-out scenes, and keeps weights and ONNX file of the best one."""

    def __init__(
        self,
        arguments: argparse.Namespace,
        name: str,
        export: Callable[..., None],
        measure: Callable[[Path], float],
    ) -> None:
        self._stem = arguments.out / name
        self._export, self._measure = export, measure
        self._properties = _properties(name, arguments.seed)
        self._best = -1.0

    def check(self, net: nn.Module, step: int) -> dict[str, float]:
        trial = self._stem.with_suffix(".trial.onnx")
        self._export(
            copy.deepcopy(net), trial, properties={**self._properties, "hvt.training_step": str(step)}
        )
        quality = self._measure(trial)
        if quality >= self._best:
            self._best = quality
            torch.save(net.state_dict(), self._stem.with_suffix(".pt"))
            trial.replace(self._stem.with_suffix(".onnx"))
        return {"validation": round(quality, 4)}


def _properties(name: str, seed: int) -> dict[str, str]:
    return metadata(
        name=name,
        classes=CLASSES if name == DETECTOR else CLASS_NAMES,
        seed=seed,
        commit=_commit(),
        date=dt.datetime.now(dt.UTC).date().isoformat(),
        summary=_SUMMARY[name],
        **{"hvt.training_data": _CREDITS},
    )


def _commit() -> str:
    """The commit that is checked out, with a plus where files differ from it; "unknown" outside a repository."""
    try:
        head, changes = _git("rev-parse", "HEAD"), _git("status", "--porcelain", ".")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return head + ("+" if changes else "")


def _git(*words: str) -> str:
    command = ["git", *words]
    done = subprocess.run(command, cwd=Path(__file__).parent, check=True, capture_output=True, text=True)  # noqa: S603
    return done.stdout.strip()


def _seconds(arguments: argparse.Namespace) -> float | None:
    return None if arguments.minutes is None else arguments.minutes * 60
