"""Turns pixels into a network's input, as its file says or as its kind is trained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hvt_common.errors import UserError


@dataclass(frozen=True, slots=True)
class Preparation:
    """Network value = (pixel - mean) * scale, channel by channel, pixels 0…255, in the network's channel order."""

    mean: tuple[float, float, float]
    scale: tuple[float, float, float]
    rgb: bool = True
    """The network wants RGB, not BGR."""

    @classmethod
    def torchvision(cls) -> Preparation:
        """The preparation of torchvision and the ONNX model zoo for ImageNet."""
        return cls(mean=(123.675, 116.28, 103.53), scale=(1 / 58.395, 1 / 57.12, 1 / 57.375))

    def __str__(self) -> str:
        order = "RGB" if self.rgb else "BGR"
        mean, divisor = (
            " ".join(f"{value:.6g}" for value in dict.fromkeys(values))
            for values in (self.mean, tuple(1 / scale for scale in self.scale))
        )
        if mean == "0" and divisor in ("1", "255"):
            return f"{order} 0…{255 if divisor == '1' else 1}"
        return f"{order}, (pixel - {mean}) / {divisor}"


def prepared_as(path: Path, metadata: Mapping[str, str], usual: Preparation) -> Preparation:
    """Pixels by a model's metadata (``hvt.mean``, ``hvt.scale``, ``hvt.channel_order``), else as usual.

    Raises `UserError` where they make no sense.
    """
    order = metadata.get("hvt.channel_order", "RGB" if usual.rgb else "BGR").upper()
    if order not in ("RGB", "BGR"):
        raise UserError(
            f"model {path} has hvt.channel_order '{order}' in its metadata; RGB or BGR is accepted"
        )
    return Preparation(
        mean=_three_numbers(path, metadata, "hvt.mean", usual.mean),
        scale=_three_numbers(path, metadata, "hvt.scale", usual.scale),
        rgb=order == "RGB",
    )


def _three_numbers(
    path: Path, metadata: Mapping[str, str], key: str, usual: tuple[float, float, float]
) -> tuple[float, float, float]:
    # One number for all channels or three, separated by spaces or commas, with or without brackets.
    if key not in metadata:
        return usual
    try:
        numbers = [float(word) for word in metadata[key].strip("[]() ").replace(",", " ").split()]
    except ValueError:
        numbers = []
    nothing = key == "hvt.scale" and 0 in numbers
    if len(numbers) not in (1, 3) or not np.isfinite(numbers).all() or nothing:
        accepted = f"one number or three do{', not 0' if nothing else ''}"
        raise UserError(f"model {path} has {key} '{metadata[key]:.80}' in its metadata; {accepted}")
    red, green, blue = numbers * 3 if len(numbers) == 1 else numbers
    return red, green, blue
