"""The network of ``aerial-cls`` and its training: a small residual network over 96 x 96 crops."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.data import DataLoader, IterableDataset

from hvt_scene.drawing.vehicles import CLASS_NAMES
from hvt_train.learning.export import export_onnx, load_onnx
from hvt_train.learning.loop import LoopSettings, Loss, train
from hvt_train.pictures.crops import CROP_SIDE, CropSource

MEAN, SCALE = 115.0, 1 / 60
"""Network value = (pixel - MEAN) * SCALE on all channels; also written into the file's metadata."""


class _Conv(nn.Sequential):
    """Convolution, batch norm, ReLU."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 1, stride: int = 1) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False),
            nn.BatchNorm2d(outputs, eps=1e-3, momentum=0.03),
            nn.ReLU(inplace=True),
        )


class _Block(nn.Module):
    """A residual block: 1x1 to half the width, 3x3 back."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.squeeze = _Conv(width, width // 2)
        self.spread = _Conv(width // 2, width, 3)

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) to the same shape."""
        out: Tensor = x + self.spread(self.squeeze(x))
        return out


class ClassifierNet(nn.Sequential):
    """(N, 3, 96, 96) BGR to (N, C) logits."""

    def __init__(self, classes: int) -> None:
        super().__init__(
            _Conv(3, 16, 3, 2),
            _Conv(16, 32, 3, 2),
            _Block(32),
            _Conv(32, 64, 3, 2),
            _Block(64),
            _Block(64),
            _Conv(64, 128, 3, 2),
            _Block(128),
            _Block(128),
            nn.AdaptiveAvgPool2d(1),
            nn.Flatten(),
            nn.Dropout(0.1),
            nn.Linear(128, classes),
        )


Example = tuple[np.ndarray, int]


class _Stream(IterableDataset[Example]):
    def __init__(self, source: CropSource) -> None:
        self._source = source

    def __iter__(self) -> Iterator[Example]:
        while True:
            yield self._source.next()


def _batch_of(examples: list[Example]) -> tuple[Tensor, Tensor]:
    images = np.stack([image.transpose(2, 0, 1) for image, _ in examples])
    return torch.from_numpy(images), torch.tensor([kind for _, kind in examples])


def _loss_of(net: nn.Module, batch: tuple[Tensor, Tensor]) -> Loss:
    images, kinds = batch
    values = ((images.float() - MEAN) * SCALE).contiguous(memory_format=torch.channels_last)
    logits = net(values).float()
    loss = functional.cross_entropy(logits, kinds, label_smoothing=0.03)
    return loss, {"top1": (logits.argmax(1) == kinds).float().mean()}


def train_classifier(
    source: CropSource,
    *,
    settings: LoopSettings,
    seed: int,
    batch: int,
    workers: int,
    log: Path,
    check: Callable[[nn.Module, int], dict[str, float]] | None = None,
    start: Path | None = None,
) -> ClassifierNet:
    """Train on crops; ``start`` is an ONNX file to go on from."""
    torch.manual_seed(seed)
    loader = DataLoader(
        _Stream(source),
        batch_size=batch,
        collate_fn=_batch_of,
        num_workers=workers,
        prefetch_factor=4 if workers else None,
    )
    net = ClassifierNet(len(CLASS_NAMES))
    if start is not None:
        images, _ = _batch_of([source.next() for _ in range(128)])
        load_onnx(net, start, (images.float() - MEAN) * SCALE)
    trained = train(net, loader, loss_of=_loss_of, settings=settings, log=log, check=check)
    assert isinstance(trained, ClassifierNet)
    return trained


def export_classifier(
    net: ClassifierNet, path: Path, *, properties: dict[str, str], temperature: float = 1.0
) -> None:
    """Write the ONNX file: (N, 3, 96, 96) prepared pixels in, (N, C) logits, divided by ``temperature``, out."""
    net = copy.deepcopy(net)
    last = net[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        last.weight /= temperature
        last.bias /= temperature
    own = {"hvt.mean": str(MEAN), "hvt.scale": repr(SCALE), "hvt.channel_order": "BGR"}
    export_onnx(
        net,
        path,
        example=torch.zeros(2, 3, CROP_SIDE, CROP_SIDE),
        free={"images": {0: "batch"}, "output": {0: "batch"}},
        properties={**properties, **own},
    )
