"""A user's own objects: go on from ``aerial-nano`` with his pictures, until the held-out ones gain no more."""

from __future__ import annotations

import contextlib
import copy
import datetime as dt
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import nn

from hvt_common.errors import UserError
from hvt_common.files import write_whole
from hvt_common.inference.class_names import kind_of
from hvt_common.inference.detect import open_detector
from hvt_train.learning.calibration import NONE, Calibration, fit_calibration
from hvt_train.learning.detector import DetectorNet
from hvt_train.learning.export import load_onnx, metadata
from hvt_train.learning.loop import LoopSettings
from hvt_train.learning.train_detector import export_detector, train_detector
from hvt_train.pictures.places import Picture
from hvt_train.pictures.pool import in_flight, save_picture, thin_kbps
from hvt_train.pictures.real import HeldOut
from hvt_train.pictures.views import ViewSettings

_CODED_SHARE = 0.65
"""Share of the pictures that go through x265, as a detector on a thin base meets them. The others stay unchanged."""
_PLAUSIBLE = (0.1, 10.0)
"""Slopes of a calibration; another one comes of too few boxes."""
_STEPS_BETWEEN = 5
_WARM_UP, _AVERAGE = 40, 0.99


class _EnoughError(Exception):
    """Nothing is gained any more, or the time is up."""


@dataclass(frozen=True, slots=True)
class FineTuneSettings:
    """How long and how fast."""

    steps: int
    budget_s: float
    check_every: int = 25
    """Steps between two measurements on the held-out pictures; a multiple of 5."""
    patience: int = 8
    """Measurements without a better one after which it ends."""
    batch: int = 8
    side: int = 320
    """Side of a view, pixels; a multiple of 32."""
    rate: float = 1e-3
    seed: int = 1
    threads: int = 2


@dataclass(frozen=True, slots=True)
class FineTuned:
    """The result of the training."""

    steps: int
    best_step: int
    calibration: Calibration | None
    """None: too few boxes to fit one."""


def fill_own(folder: Path, pictures: Iterable[Picture], *, seed: int) -> list[Path]:
    """Write the pool that `fine_tune` learns from: base pictures, most of them as a thin base stream shows them.

    Files are named by the kinds of `hvt_train.pictures.views` that stand for just that: ``base`` and ``demo``.
    """
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for number, picture in enumerate(pictures):
        rng = np.random.default_rng([seed, number])
        thin = rng.random() < _CODED_SHARE
        image = in_flight(picture.image_bgr, rng, kbps=thin_kbps(rng)) if thin else picture.image_bgr
        path = folder / f"{'base' if thin else 'demo'}-{number:05d}.npz"
        save_picture(path, Picture(image, picture.boxes_px, picture.class_ids, picture.visible))
        written.append(path)
    return written


def fine_tune(
    pool: list[Path],
    held_out: Callable[[], Iterable[HeldOut]],
    *,
    classes: Sequence[str],
    start: Path,
    out: Path,
    settings: FineTuneSettings,
    measure: Callable[[Path], float],
    on_step: Callable[[int, float | None], None],
) -> FineTuned:
    """Train a network of ``classes`` into the ONNX file ``out``, with calibrated scores; a log lies beside it.

    ``pool`` is of `fill_own`. ``held_out`` gives the pictures that are not trained on, anew at each call: the
    calibration is fitted on them, and ``measure`` scores the network of a file on them; the best is kept.
    ``start`` is an ONNX file of the same network (else `UserError`), as whose classes those of the same kind begin.
    ``on_step`` is called with the steps done, and with the score of a step that was measured.
    """
    cv2.setNumThreads(1)
    torch.set_num_threads(settings.threads)
    known = open_detector(str(start)).class_names
    _check(start, len(known))
    trial = pool[0].with_name("trial.onnx")
    best = _Best(
        classes, start=start, out=out, trial=trial, settings=settings, measure=measure, on_step=on_step
    )
    loop = LoopSettings(
        steps=settings.steps,
        rate=settings.rate,
        warm_up=_WARM_UP,
        average=_AVERAGE,
        check_every=_STEPS_BETWEEN,
        budget_s=settings.budget_s,
    )
    log = out.with_suffix(".jsonl")
    log.unlink(missing_ok=True)
    with contextlib.suppress(_EnoughError):
        train_detector(
            pool,
            settings=loop,
            views=ViewSettings(side=settings.side, tiled=0.0),
            seed=settings.seed,
            batch=settings.batch,
            workers=0,
            log=log,
            check=best.check,
            start=start,
            classes=_alike(classes, known),
        )
    calibration = best.calibrate(held_out)
    return FineTuned(best.steps, best.best_step, calibration)


def _check(start: Path, classes: int) -> None:
    try:
        load_onnx(DetectorNet(classes), start, torch.zeros(1, 3, 64, 64))
    except (ValueError, IndexError, KeyError) as error:
        raise UserError(f"--start {start} is not of aerial-nano's network: {error}") from None


def _alike(classes: Sequence[str], known: Sequence[str]) -> list[str]:
    """Own names, in the words of the file where it has a class of the same kind."""
    words = {kind_of(name): name for name in reversed(known)}
    return [name if name in known else words.get(kind_of(name), name) for name in classes]


class _Best:
    """Measures the averaged network now and then, and keeps the best."""

    def __init__(
        self,
        classes: Sequence[str],
        *,
        start: Path,
        out: Path,
        trial: Path,
        settings: FineTuneSettings,
        measure: Callable[[Path], float],
        on_step: Callable[[int, float | None], None],
    ) -> None:
        self._classes, self._out, self._trial, self._settings = classes, out, trial, settings
        self._measure, self._on_step = measure, on_step
        self._quality, self._in_vain = -1.0, 0
        self._net: nn.Module | None = None
        self._began_s = time.monotonic()
        self.steps = self.best_step = 0
        self._properties = metadata(
            name=out.stem,
            classes=classes,
            seed=settings.seed,
            commit="own",
            date=dt.datetime.now(dt.UTC).date().isoformat(),
            summary=f"{', '.join(classes)}; gone on from {start.stem} with own pictures.",
        )

    def check(self, net: nn.Module, step: int) -> dict[str, float]:
        """Every few steps; `_EnoughError` ends the training."""
        self.steps, settings = step, self._settings
        late = time.monotonic() - self._began_s >= settings.budget_s
        if step % settings.check_every and step != settings.steps and not late:
            self._on_step(step, None)
            return {}
        self._export(copy.deepcopy(net), self._trial, NONE)
        quality = self._measure(self._trial)
        self._on_step(step, quality)
        self._in_vain += 1
        if quality > self._quality:
            self._quality, self._in_vain, self.best_step = quality, 0, step
            self._net = copy.deepcopy(net)
            write_whole(self._out, self._trial.read_bytes())
        if self._in_vain >= settings.patience or late:
            raise _EnoughError
        return {"validation": round(quality, 4)}

    def calibrate(self, held_out: Callable[[], Iterable[HeldOut]]) -> Calibration | None:
        """Write the best network again, with scores that say how often a box is right on the held-out pictures."""
        assert isinstance(self._net, DetectorNet), "the last step is measured"
        detector = open_detector(str(self._out), confidence=0.02, threads=self._settings.threads)
        try:
            found = fit_calibration(detector, held_out())
        except ValueError:  # no boxes, or all of them right
            return None
        if not _PLAUSIBLE[0] <= found.slope <= _PLAUSIBLE[1]:
            return None
        self._export(self._net, self._out, found)
        return found

    def _export(self, net: nn.Module, path: Path, calibration: Calibration) -> None:
        assert isinstance(net, DetectorNet)
        fitted = {
            "hvt.calibration": f"{calibration.slope:.4f} {calibration.shift:.4f}",
            "hvt.confidence": f"{calibration.confidence:.2f}",
        }
        properties = self._properties | (fitted if calibration != NONE else {})
        export_detector(net, path, properties=properties, calibration=calibration)
