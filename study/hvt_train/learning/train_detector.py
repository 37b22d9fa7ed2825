"""Training ``aerial-nano``: which cells answer for which object, and how wrong they are.

The assignment is SimOTA's (YOLOX, Ge et al., 2021) over few candidates: instead of every cell of the picture, each
object considers the 3 x 3 cells around its centre on the strides that suit its size, and takes as many of the
cheapest as its best overlaps add up to, at least two. Objects of class -1 are neither learnt nor held against a cell.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from hvt_common.inference.detect import open_detector
from hvt_scene.drawing.vehicles import CLASS_NAMES
from hvt_train.learning.calibration import NONE, Calibration
from hvt_train.learning.detector import STRIDES, DetectorNet, ExportedDetector
from hvt_train.learning.export import export_onnx, load_onnx
from hvt_train.learning.loop import LoopSettings, Loss, train
from hvt_train.pictures.kinds import AMONG
from hvt_train.pictures.views import View, ViewSettings, ViewSource

_RANGES = ((0.0, 110.0), (22.0, 240.0), (70.0, 1e6))
"""Longer sides in pixels for which a stride may answer."""
_FAR = 1e4


@dataclass(frozen=True, slots=True)
class Targets:
    """The objects of a batch, one row each."""

    pictures: Tensor
    """(M,) int64, which picture of the batch."""
    boxes_px: Tensor
    """(M, 4) float32 x1 y1 x2 y2."""
    class_ids: Tensor
    """(M,) int64; -1 is ignored; below it the set does not tell which of `AMONG` it is."""

    def to(self, device: torch.device) -> Targets:
        return Targets(
            *(rows.to(device, non_blocking=True) for rows in (self.pictures, self.boxes_px, self.class_ids))
        )


def detector_loss(maps: list[Tensor], targets: Targets) -> tuple[Tensor, dict[str, Tensor]]:
    """Weighted sum of overlap, objectness and class losses, and its parts for the log."""
    rows, grid, stride, shapes = _flat(maps)
    targets = Targets(targets.pictures, targets.boxes_px, _named(rows.detach(), shapes, targets))
    boxes = _decoded(rows[..., :4], grid, stride)
    real = targets.class_ids >= 0
    with torch.no_grad():
        cells, owners = _assign(rows, boxes, shapes, targets)
        weights = _forgiving(len(rows), grid, stride, targets.pictures[~real], targets.boxes_px[~real])
    count = max(len(cells), 1)
    wanted = torch.zeros_like(weights)
    pictures = targets.pictures[owners]
    wanted[pictures, cells] = 1.0
    weights[pictures, cells] = 1.0
    objectness = (
        functional.binary_cross_entropy_with_logits(rows[..., 4], wanted, weights, reduction="sum") / count
    )
    hit, aim = boxes[pictures, cells], targets.boxes_px[owners]
    overlap, generalised = _overlaps(hit, aim)
    shape = (1 - generalised).sum() / count
    kinds = functional.one_hot(targets.class_ids[owners].clamp(min=0), rows.shape[2] - 5).float()
    kinds = kinds * overlap.detach().clamp(min=0.3)[:, None]
    naming = (
        functional.binary_cross_entropy_with_logits(rows[pictures, cells, 5:], kinds, reduction="sum") / count
    )
    total = 4.0 * shape + objectness + naming
    parts = {
        "box": shape.detach(),
        "objectness": objectness.detach(),
        "class": naming.detach(),
        "cells": torch.tensor(float(len(cells))),
    }
    return total, parts


def _named(rows: Tensor, shapes: list[tuple[int, int]], targets: Targets) -> Tensor:
    """Class ids in which a class that a set does not tell is the likeliest of `AMONG` by the network as it is now."""
    kinds = targets.class_ids.clone()
    which = torch.nonzero(kinds < -1)[:, 0]
    if len(which):
        numbers, allowed = _candidates(shapes, targets.boxes_px[which])
        said = rows[targets.pictures[which][:, None], numbers, 5:]
        mean = (said * allowed[..., None]).sum(1) / allowed.sum(1).clamp(min=1)[:, None]
        table = torch.full((2 + len(AMONG), rows.shape[2] - 5), -1e9)
        for code, favoured in AMONG.items():
            for kind, logits in favoured.items():
                table[-code, kind] = logits
        kinds[which] = (mean + table.to(rows.device)[-kinds[which]]).argmax(1)
    return kinds


def _flat(maps: list[Tensor]) -> tuple[Tensor, Tensor, Tensor, list[tuple[int, int]]]:
    """(N, A, 5 + C) rows, (A, 2) cell indices, (A, 1) strides, and (h, w) of each level."""
    rows = torch.cat([level.float().flatten(2) for level in maps], dim=2).transpose(1, 2)
    grids, strides, shapes = [], [], []
    for level, stride in zip(maps, STRIDES, strict=True):
        high, wide = level.shape[2:]
        axes = (torch.arange(side, device=rows.device) for side in (high, wide))
        y, x = torch.meshgrid(*axes, indexing="ij")
        grids.append(torch.stack([x.flatten(), y.flatten()], 1).float())
        strides.append(torch.full((high * wide, 1), float(stride), device=rows.device))
        shapes.append((high, wide))
    return rows, torch.cat(grids), torch.cat(strides), shapes


def _decoded(rows: Tensor, grid: Tensor, stride: Tensor) -> Tensor:
    """(N, A, 4) x1 y1 x2 y2 in pixels."""
    centres = (rows[..., :2] + grid) * stride
    half = rows[..., 2:4].clamp(max=6.0).exp() * stride / 2
    return torch.cat([centres - half, centres + half], dim=-1)


def _overlaps(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """IoU and generalised IoU of matching rows."""
    inner = (
        (torch.minimum(a[..., 2:], b[..., 2:]) - torch.maximum(a[..., :2], b[..., :2])).clamp(min=0).prod(-1)
    )
    outer = (
        (torch.maximum(a[..., 2:], b[..., 2:]) - torch.minimum(a[..., :2], b[..., :2]))
        .clamp(min=1e-6)
        .prod(-1)
    )
    union = (a[..., 2:] - a[..., :2]).prod(-1) + (b[..., 2:] - b[..., :2]).prod(-1) - inner + 1e-6
    overlap = inner / union
    return overlap, overlap - (outer - union) / outer


def _candidates(shapes: list[tuple[int, int]], boxes: Tensor) -> tuple[Tensor, Tensor]:
    """(M, 27) cell numbers and whether each may answer: in the picture, and of a stride that suits the size."""
    centre, longest = (boxes[:, :2] + boxes[:, 2:]) / 2, (boxes[:, 2:] - boxes[:, :2]).amax(1)
    step = torch.tensor([(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1)], device=boxes.device)
    numbers, allowed, start = [], [], 0
    for (high, wide), stride, (low, most) in zip(shapes, STRIDES, _RANGES, strict=True):
        cell = (centre / stride).floor().long()[:, None] + step
        inside = (cell >= 0).all(-1) & (cell[..., 0] < wide) & (cell[..., 1] < high)
        # Beyond three quarters of a stride outside the box a neighbour's cell is no candidate.
        middle = (cell + 0.5) * stride
        near = (
            (middle > boxes[:, None, :2] - 0.75 * stride) & (middle < boxes[:, None, 2:] + 0.75 * stride)
        ).all(-1)
        suits = (longest >= low) & (longest < most)
        numbers.append(start + (cell[..., 1] * wide + cell[..., 0]) * inside)
        allowed.append(inside & near & suits[:, None])
        start += high * wide
    return torch.cat(numbers, 1), torch.cat(allowed, 1)


def _assign(
    rows: Tensor, boxes: Tensor, shapes: list[tuple[int, int]], targets: Targets
) -> tuple[Tensor, Tensor]:
    """Which cells answer, and for which row of the targets."""
    real = torch.nonzero(targets.class_ids >= 0)[:, 0]
    aims, pictures, kinds = targets.boxes_px[real], targets.pictures[real], targets.class_ids[real]
    if len(real) == 0:
        return real, real
    numbers, allowed = _candidates(shapes, aims)
    picked = rows[pictures[:, None], numbers]
    overlap, _ = _overlaps(boxes[pictures[:, None], numbers], aims[:, None])
    score = (
        picked[..., 4].sigmoid()
        * picked.gather(2, (5 + kinds)[:, None, None].expand(-1, 27, 1))[..., 0].sigmoid()
    )
    cost = -(score.clamp(min=1e-8).sqrt().log()) - 3.0 * (overlap + 1e-8).log() + _FAR * ~allowed
    share = (overlap * allowed).topk(10, dim=1).values.sum(1)
    wanted = share.floor().clamp(min=2, max=9).long()
    rank = cost.argsort(1).argsort(1)
    chosen = (rank < wanted[:, None]) & allowed
    owner, slot = torch.nonzero(chosen, as_tuple=True)
    return _resolved(numbers[owner, slot], owner, cost[owner, slot], pictures, real, total=rows.shape[1])


def _resolved(
    cells: Tensor, owner: Tensor, cost: Tensor, pictures: Tensor, real: Tensor, *, total: int
) -> tuple[Tensor, Tensor]:
    """A cell that several objects want goes to the cheapest."""
    key = pictures[owner] * total + cells
    order = cost.argsort().argsort()
    size = int(key.max()) + 1 if len(key) else 1
    least = torch.full((size,), len(key), device=key.device).scatter_reduce(0, key, order, "amin")
    won = least[key] == order
    return cells[won], real[owner[won]]


def _forgiving(count: int, grid: Tensor, stride: Tensor, pictures: Tensor, boxes: Tensor) -> Tensor:
    """(N, A) 1, but 0 for cells whose middle lies in an ignored box: they do not count as background."""
    middle = (grid + 0.5) * stride
    weights = torch.ones(count, len(grid), device=grid.device)
    if len(boxes):
        inside = ((middle > boxes[:, None, :2] - 2) & (middle < boxes[:, None, 2:] + 2)).all(2)
        hidden = torch.zeros_like(weights).index_add_(0, pictures, inside.float())
        weights[hidden > 0] = 0.0
    return weights


_LIKE = {"van": "car", "motor": "motorcycle", "pedestrian": "person"}
"""The closest class of COCO."""


@dataclass(frozen=True, slots=True)
class Batch:
    """Pictures and their objects."""

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
    images = np.stack([view.image_bgr.transpose(2, 0, 1) for view in views])
    pictures = np.concatenate([np.full(len(view.boxes_px), i) for i, view in enumerate(views)])
    boxes = np.concatenate([view.boxes_px for view in views]).astype(np.float32)
    kinds = np.concatenate([view.class_ids for view in views]).astype(np.int64)
    targets = Targets(
        torch.from_numpy(pictures.astype(np.int64)), torch.from_numpy(boxes), torch.from_numpy(kinds)
    )
    return Batch(torch.from_numpy(images), targets)


def loss_of(net: nn.Module, batch: Batch) -> Loss:
    device = next(net.parameters()).device
    images = batch.images.to(device, non_blocking=True).float().contiguous(memory_format=torch.channels_last)
    maps = net(images)
    with torch.autocast(device.type, enabled=False):
        return detector_loss(maps, batch.targets.to(device))


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
        pin_memory=settings.device != "cpu",
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
