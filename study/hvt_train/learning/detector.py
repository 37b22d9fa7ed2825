"""The network of ``aerial-nano``: dense convolutions (fast on a CPU), three strides, one anchor-free head each."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

__all__ = ["STRIDES", "DetectorNet", "DetectorShape", "ExportedDetector"]

STRIDES = (8, 16, 32)


@dataclass(frozen=True, slots=True)
class DetectorShape:
    """Widths of the stem and of strides 4, 8, 16, 32; blocks of the last four; width of the neck."""

    widths: tuple[int, int, int, int, int] = (16, 32, 64, 128, 192)
    blocks: tuple[int, int, int, int] = (1, 2, 3, 2)
    neck: int = 64


class Conv(nn.Sequential):
    """Convolution, batch norm, ReLU."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 1, stride: int = 1) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False),
            nn.BatchNorm2d(outputs, eps=1e-3, momentum=0.03),
            nn.ReLU(inplace=True),
        )


class Block(nn.Module):
    """A residual block: 1x1 to half the width, 3x3 back."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.squeeze = Conv(width, width // 2)
        self.spread = Conv(width // 2, width, 3)

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) to the same shape."""
        out: Tensor = x + self.spread(self.squeeze(x))
        return out


def _stage(inputs: int, outputs: int, blocks: int) -> nn.Sequential:
    return nn.Sequential(Conv(inputs, outputs, 3, 2), *(Block(outputs) for _ in range(blocks)))


class DetectorNet(nn.Module):
    """(N, 3, H, W) BGR 0…255 to raw maps (N, 5 + C, h, w) of each stride: x, y, log w, log h, objectness, classes."""

    def __init__(self, classes: int, shape: DetectorShape | None = None) -> None:
        super().__init__()
        shape = shape or DetectorShape()
        w, n, neck = shape.widths, shape.blocks, shape.neck
        self.classes = classes
        self.stem = Conv(3, w[0], 3, 2)
        self.stages = nn.ModuleList(_stage(w[i], w[i + 1], n[i]) for i in range(4))
        self.lateral = nn.ModuleList(Conv(w[i], neck) for i in (2, 3, 4))
        self.merge = nn.ModuleList(Block(neck) for _ in range(2))
        self.down = nn.ModuleList(Conv(neck, neck, 3, 2) for _ in range(2))
        self.towers = nn.ModuleList(Conv(neck, neck, 3) for _ in STRIDES)
        self.heads = nn.ModuleList(nn.Conv2d(neck, 5 + classes, 1) for _ in STRIDES)
        for head in self.heads:
            nn.init.normal_(head.weight, std=0.01)
            nn.init.zeros_(head.bias)
            with torch.no_grad():
                head.bias[:2] = 0.5  # the middle of the cell
                head.bias[2:4] = 0.7  # two strides
                head.bias[4:] = -4.0

    def forward(self, images: Tensor) -> list[Tensor]:
        """Maps of strides 8, 16, 32."""
        x = self.stages[0](self.stem(images * (1 / 255) - 0.45))
        fine = self.stages[1](x)
        middle = self.stages[2](fine)
        coarse = self.stages[3](middle)
        p32 = self.lateral[2](coarse)
        p16 = self.merge[1](self.lateral[1](middle) + _doubled(p32))
        p8 = self.merge[0](self.lateral[0](fine) + _doubled(p16))
        p16 = p16 + self.down[0](p8)
        p32 = p32 + self.down[1](p16)
        levels = (p8, p16, p32)
        return [head(tower(p)) for head, tower, p in zip(self.heads, self.towers, levels, strict=True)]


class ExportedDetector(nn.Module):
    """What goes into the ONNX file: the maps as YOLOX's raw head (N, A, 5 + C), scores as probabilities.

    ``slope`` and ``shift`` are those of a `calibration.Calibration`: objectness times the likeliest class is the
    calibrated score.
    """

    def __init__(self, net: DetectorNet, *, slope: float = 1.0, shift: float = 0.0) -> None:
        super().__init__()
        self.net, self.slope, self.shift = net, slope, shift

    def forward(self, images: Tensor) -> Tensor:
        """(N, 3, H, W) to (N, A, 5 + C), stride by stride, row by row."""
        rows = torch.cat([level.flatten(2) for level in self.net(images)], dim=2).transpose(1, 2)
        objectness, classes = rows[..., 4:5].sigmoid(), rows[..., 5:].sigmoid()
        best = classes.amax(dim=2, keepdim=True)
        score = (objectness * best).clamp(1e-6, 1 - 1e-6)
        true = (self.slope * (score / (1 - score)).log() + self.shift).sigmoid()
        return torch.cat([rows[..., :4], (true / best).clamp(max=1.0), classes], dim=2)


def _doubled(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2.0, mode="nearest")
