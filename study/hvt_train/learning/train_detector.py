"""Training ``aerial-nano``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from hvt_common.inference.detect import open_detector
from hvt_scene.drawing.vehicles import CLASS_NAMES
from hvt_train.learning.calibration import NONE, Calibration
from hvt_train.learning.detector import DetectorNet, ExportedDetector
from hvt_train.learning.export import export_onnx
from hvt_train.learning.loop import LoopSettings, Loss, train
from hvt_train.learning.loss import Targets, detector_loss
from hvt_train.learning.start import load_onnx
from hvt_train.pictures.views import View, ViewSettings, ViewSource

_LIKE = {"van": "car", "motor": "motorcycle", "pedestrian": "person"}
"""What of COCO's classes comes closest."""


@dataclass(frozen=True, slots=True)
class Batch:
    """Pictures and what is in them."""

    images: torch.Tensor
    """(N, 3, H, W) uint8 BGR."""
    targets: Targets


class _Views(IterableDataset[View]):
    def __init__(self, pool: list[Path], *, seed: int, settings: ViewSettings) -> None:
        self._pool, self._seed, self._settings = pool, seed, settings

    def __iter__(self) -> Iterator[View]:
        info = get_worker_info()
        source = ViewSource(self._pool, seed=self._seed + (info.id if info else 0), settings=self._settings)
        while True:
            yield source.next()


def batch_of(views: list[View]) -> Batch:
    """Put views of one size together."""
    images = np.stack([view.image_bgr.transpose(2, 0, 1) for view in views])
    pictures = np.concatenate([np.full(len(view.boxes_px), i) for i, view in enumerate(views)])
    boxes = np.concatenate([view.boxes_px for view in views]).astype(np.float32)
    kinds = np.concatenate([view.class_ids for view in views]).astype(np.int64)
    targets = Targets(
        torch.from_numpy(pictures.astype(np.int64)), torch.from_numpy(boxes), torch.from_numpy(kinds)
    )
    return Batch(torch.from_numpy(images), targets)


def loss_of(net: nn.Module, batch: Batch) -> Loss:
    """The loss of a batch."""
    images = batch.images.float().contiguous(memory_format=torch.channels_last)
    maps = net(images)
    with torch.autocast("cpu", enabled=False):
        return detector_loss(maps, batch.targets)


def train_detector(
    pool: list[Path],
    *,
    settings: LoopSettings,
    views: ViewSettings,
    seed: int,
    batch: int,
    workers: int,
    log: Path,
    check: Callable[[nn.Module, int], dict[str, float]] | None = None,
    start: Path | None = None,
    classes: Sequence[str] = CLASS_NAMES,
) -> DetectorNet:
    """Train on a pool; ``start`` is an ONNX file of this network, of these or other classes, or a state (``.pt``)."""
    torch.manual_seed(seed)
    net = DetectorNet(len(classes))
    if start is not None and start.suffix == ".onnx":
        source = ViewSource(pool, seed=seed, settings=views)
        images = batch_of([source.next() for _ in range(48)]).images.float()
        load_onnx(net, start, images, rows=_rows(classes, open_detector(str(start)).class_names))
    elif start is not None:
        net.load_state_dict(torch.load(start))
    loader = DataLoader(
        _Views(pool, seed=seed * 1000, settings=views),
        batch_size=batch,
        collate_fn=batch_of,
        num_workers=workers,
        prefetch_factor=4 if workers else None,
    )
    trained = train(net, loader, loss_of=loss_of, settings=settings, log=log, check=check)
    assert isinstance(trained, DetectorNet)
    return trained


def _rows(classes: Sequence[str], theirs: Sequence[str]) -> list[int]:
    """For each class the one of the file that it begins as; -1: none."""
    found = [next((n for n in (name, _LIKE.get(name)) if n in theirs), None) for name in classes]
    return [-1 if name is None else theirs.index(name) for name in found]


def export_detector(
    net: DetectorNet, path: Path, *, properties: dict[str, str], calibration: Calibration = NONE
) -> None:
    """Write the ONNX file: (1, 3, H, W) BGR 0…255 in, YOLOX's raw head out, H and W free multiples of 32."""
    export_onnx(
        ExportedDetector(net, slope=calibration.slope, shift=calibration.shift),
        path,
        example=torch.zeros(1, 3, 256, 320),
        free={"images": {2: "height", 3: "width"}, "output": {1: "cells"}},
        properties=properties | {"hvt.enlarge_to": "1280"},
    )
