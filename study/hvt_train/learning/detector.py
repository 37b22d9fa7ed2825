"""The network of ``aerial-nano``: YOLOX-nano (Ge et al., 2021) as a processor likes it, begun from its COCO weights.

Half of YOLOX-nano's time on a CPU is its first layer; as one convolution of 6x6 it computes the same in a quarter of
the time. ReLU instead of SiLU, and more blocks where they cost little.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

STRIDES = (8, 16, 32)
_HEAD = 64


class Conv(nn.Sequential):
    """Convolution, batch norm, ReLU."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 1, stride: int = 1, groups: int = 1) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, kernel, stride, (kernel - 1) // 2, groups=groups, bias=False),
            nn.BatchNorm2d(outputs, eps=1e-3, momentum=0.03),
            nn.ReLU(inplace=True),
        )


class Separable(nn.Sequential):
    """A 3x3 convolution channel by channel, then a 1x1 across them."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__(Conv(inputs, inputs, 3, stride, inputs), Conv(inputs, outputs))


class Block(nn.Module):
    """1x1, then separable 3x3; ``residual`` adds the input."""

    def __init__(self, width: int, *, residual: bool) -> None:
        super().__init__()
        self.residual, self.mix, self.spread = residual, Conv(width, width), Separable(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) to the same shape."""
        out: Tensor = self.spread(self.mix(x))
        return x + out if self.residual else out


class Added(nn.Sequential):
    """Residual blocks that YOLOX-nano has not; they begin as nearly nothing."""

    def __init__(self, width: int, blocks: int) -> None:
        super().__init__(*(Block(width, residual=True) for _ in range(blocks)))
        for block in self:
            assert isinstance(block, Block)
            norm = block.spread[1][1]
            assert isinstance(norm, nn.BatchNorm2d)
            nn.init.constant_(norm.weight, 0.2)


class CrossStage(nn.Module):
    """Half of the channels go through ``blocks``, half past them (CSPNet, Wang et al., 2020)."""

    def __init__(
        self, inputs: int, outputs: int, blocks: int = 1, *, residual: bool = False, added: int = 0
    ) -> None:
        super().__init__()
        half = outputs // 2
        self.through, self.bypass = Conv(inputs, half), Conv(inputs, half)
        self.blocks = nn.Sequential(*(Block(half, residual=residual) for _ in range(blocks)))
        if added:
            self.blocks.append(Added(half, added))
        self.join = Conv(outputs, outputs)

    def forward(self, x: Tensor) -> Tensor:
        """(N, inputs, H, W) to (N, outputs, H, W)."""
        # The order of the convolutions is that of the published file: `start.load_onnx` goes by it.
        through, bypass = self.through(x), self.bypass(x)
        out: Tensor = self.join(torch.cat([self.blocks(through), bypass], dim=1))
        return out


class Pyramid(nn.Module):
    """Spatial pyramid pooling: the maxima of 5, 9 and 13 cells beside the values themselves."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.squeeze, self.join = Conv(width, width // 2), Conv(width * 2, width)

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) to the same shape."""
        x = self.squeeze(x)
        pooled = [functional.max_pool2d(x, side, stride=1, padding=side // 2) for side in (5, 9, 13)]
        out: Tensor = self.join(torch.cat([x, *pooled], dim=1))
        return out


class Head(nn.Module):
    """Two towers on one stride: class scores, and box with objectness."""

    def __init__(self, inputs: int, classes: int) -> None:
        super().__init__()
        self.stem = Conv(inputs, _HEAD)
        self.naming = nn.Sequential(Separable(_HEAD, _HEAD), Separable(_HEAD, _HEAD))
        self.classes = nn.Conv2d(_HEAD, classes, 1)
        self.placing = nn.Sequential(Separable(_HEAD, _HEAD), Separable(_HEAD, _HEAD))
        self.box, self.objectness = nn.Conv2d(_HEAD, 4, 1), nn.Conv2d(_HEAD, 1, 1)
        for scores in (self.classes, self.objectness):
            assert scores.bias is not None
            nn.init.constant_(scores.bias, -4.6)  # a hundredth at first

    def forward(self, x: Tensor) -> Tensor:
        """(N, inputs, h, w) to (N, 5 + classes, h, w)."""
        x = self.stem(x)
        classes, place = self.classes(self.naming(x)), self.placing(x)
        return torch.cat([self.box(place), self.objectness(place), classes], dim=1)


class DetectorNet(nn.Module):
    """(N, 3, H, W) BGR 0…255 to raw maps (N, 5 + C, h, w) of each stride: x, y, log w, log h, objectness, classes."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.classes = classes
        self.stem = Conv(3, 16, 6, 2)
        self.stages = nn.ModuleList(
            [
                nn.Sequential(Separable(16, 32, 2), CrossStage(32, 32, 1, residual=True)),
                nn.Sequential(Separable(32, 64, 2), CrossStage(64, 64, 3, residual=True, added=1)),
                nn.Sequential(Separable(64, 128, 2), CrossStage(128, 128, 3, residual=True, added=3)),
                nn.Sequential(Separable(128, 256, 2), Pyramid(256), CrossStage(256, 256)),
            ]
        )
        self.narrow = nn.ModuleList([Conv(256, 128), Conv(128, 64)])
        self.up = nn.ModuleList([CrossStage(256, 128), CrossStage(128, 64)])
        self.down = nn.ModuleList([Separable(64, 64, 2), Separable(128, 128, 2)])
        self.out = nn.ModuleList([CrossStage(128, 128), CrossStage(256, 256)])
        self.heads = nn.ModuleList(Head(width, classes) for width in (64, 128, 256))

    def forward(self, images: Tensor) -> list[Tensor]:
        """Maps of strides 8, 16, 32."""
        x = self.stages[0](self.stem(images))
        fine = self.stages[1](x)
        middle = self.stages[2](fine)
        coarse = self.narrow[0](self.stages[3](middle))
        between = self.narrow[1](self.up[0](torch.cat([_doubled(coarse), middle], dim=1)))
        p8 = self.up[1](torch.cat([_doubled(between), fine], dim=1))
        p16 = self.out[0](torch.cat([self.down[0](p8), between], dim=1))
        p32 = self.out[1](torch.cat([self.down[1](p16), coarse], dim=1))
        return [head(level) for head, level in zip(self.heads, (p8, p16, p32), strict=True)]


class ExportedDetector(nn.Module):
    """The network of the ONNX file: its maps as YOLOX's raw head (N, A, 5 + C), scores as probabilities.

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
        return torch.cat([rows[..., :4], true, classes / best], dim=2)


def _doubled(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2.0, mode="nearest")
