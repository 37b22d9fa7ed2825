"""The contract of a head: which outputs it reads, how it wants its pixels, and boxes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from hvt_common.inference.letterbox import Anchor
from hvt_common.inference.preparation import Preparation
from hvt_common.values import Boxes

Array = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class HeadOutput:
    """Boxes above the confidence, before suppression, in no particular order."""

    boxes_input_px: Boxes
    """(N, 4) x1 y1 x2 y2 in pixels of the network's input, finite, not clipped."""
    scores: Array
    """(N,) 0…1."""
    class_ids: npt.NDArray[np.int32]


class Decoder(Protocol):
    """Numbers to boxes."""

    def __call__(
        self, outputs: Sequence[Array], *, confidence: float, input_size: tuple[int, int]
    ) -> HeadOutput:
        """Boxes of at least this confidence; ``outputs`` are those that the head names, of one image."""


@dataclass(frozen=True, slots=True)
class Head:
    """Input and output of one family of networks."""

    name: str
    """The name for ``--head``."""
    classes: int | None
    """Number of classes; None where the outputs do not tell."""
    outputs: tuple[int, ...]
    """Which of the network's outputs ``decoder`` gets."""
    anchor: Anchor
    """Where the image lies on the input."""
    preparation: Preparation
    suppresses: bool
    """The boxes still need non-maximum suppression."""
    decoder: Decoder
    why: str
    """The evidence for it, half a sentence."""

    def decode(
        self, outputs: Sequence[npt.NDArray[Any]], *, confidence: float, input_size: tuple[int, int]
    ) -> HeadOutput:
        """Decode all outputs of one run into boxes of at least this confidence."""
        used = [outputs[index].astype(np.float32, copy=False) for index in self.outputs]
        return self.decoder(used, confidence=confidence, input_size=input_size)
