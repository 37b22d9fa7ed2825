"""From an image of any size to a network's input, pixels prepared, and from boxes on that input back to the image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError
from hvt_common.values import Boxes, Image

_LEAST_COLOUR, _PALETTE_COLOUR = 0.5, 50.0
"""Least mean of |B - G| and |G - R| in a picture with colour, as `hvt_train.join` has it; in a thermal palette."""
_UNEXPLAINED = 0.15
"""Share of the colours' variance that the brightness may leave unexplained: .11 at most under a palette like "iron",
behind JPEG too; .33 at least in pictures of the sea, whose colours are the strongest."""


@dataclass(frozen=True, slots=True)
class OwnSteps:
    """The preparation of pixels in the network's own graph."""

    top: int | None = None
    """The greatest pixel that it scales, 1 or 255; None where it scales none."""
    rgb: bool | None = None
    """Whether red comes first behind ``turned``; None where nothing tells."""
    turned: bool = False
    """It swaps red and blue."""


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

    def beside(self, own: OwnSteps) -> Preparation:
        """The remaining preparation for a network that does these steps itself."""
        rgb = (self.rgb if own.rgb is None else own.rgb) != own.turned
        if own.top is not None:
            return Preparation((0.0,) * 3, (own.top / 255,) * 3, rgb=rgb)
        step = 1 if rgb == self.rgb else -1
        (red, green, blue), (of_red, of_green, of_blue) = self.mean[::step], self.scale[::step]
        return Preparation((red, green, blue), (of_red, of_green, of_blue), rgb=rgb)

    def __str__(self) -> str:
        order = "RGB" if self.rgb else "BGR"
        mean, divisor = (
            " ".join(f"{value:.6g}" for value in dict.fromkeys(values))
            for values in (self.mean, tuple(1 / scale for scale in self.scale))
        )
        if mean == "0" and divisor in ("1", "255"):
            return f"{order} 0…{255 if divisor == '1' else 1}"
        return f"{order}, (pixel - {mean}) / {divisor}"


def prepared_as(
    path: Path, metadata: Mapping[str, str], usual: Preparation, dtype: np.dtype[Any] | None
) -> Preparation:
    """Pixels by a model's metadata (``hvt.mean``, ``hvt.scale``, ``hvt.channel_order``), else as usual.

    A network whose input ``dtype`` is uint8 scales them itself. Raises `UserError` where they make no sense.
    """
    order = metadata.get("hvt.channel_order", "RGB" if usual.rgb else "BGR").upper()
    if order not in ("RGB", "BGR"):
        raise UserError(
            f"model {path} has hvt.channel_order '{order}' in its metadata; RGB or BGR is accepted"
        )
    usual = usual.beside(OwnSteps(rgb=order == "RGB"))
    if dtype == np.uint8:
        return Preparation(mean=(0.0,) * 3, scale=(1.0,) * 3, rgb=usual.rgb)
    return Preparation(
        mean=_three_numbers(path, metadata, "hvt.mean", usual.mean),
        scale=_three_numbers(path, metadata, "hvt.scale", usual.scale),
        rgb=usual.rgb,
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


Anchor = Literal["top-left", "centre", "stretch"]
"""Where the resized image lies on the network's input; ``stretch`` fills it, whatever becomes of the shape."""

_FILL = 114  # the grey of YOLO letterboxes
_ROWS_AT_ONCE = 128
"""The planes of this many rows stay in the cache, and take no memory beside the picture."""


@dataclass(frozen=True, slots=True)
class Letterbox:
    """The place of one image on the network's input."""

    image_size: tuple[int, int]
    """(width, height) of the image in pixels."""
    content: tuple[int, int, int, int]
    """x, y, width, height of the resized image on the input, whole pixels."""

    @classmethod
    def fitted(cls, image_size: tuple[int, int], input_size: tuple[int, int], *, anchor: Anchor) -> Letterbox:
        """Fit the whole image, its shape kept, up to the rounding that the networks were trained with.

        ``top-left`` cuts the size down to whole pixels as YOLOX does, ``centre`` rounds it as Ultralytics does;
        ``stretch`` keeps no shape.
        """
        if anchor == "stretch":
            return cls(image_size, (0, 0, *input_size))
        scale = min(input_size[0] / image_size[0], input_size[1] / image_size[1])
        whole = int if anchor == "top-left" else round
        width, height = (
            min(max(whole(image * scale + 1e-9), 1), limit)
            for image, limit in zip(image_size, input_size, strict=True)
        )
        if anchor == "top-left":
            return cls(image_size, (0, 0, width, height))
        left = round((input_size[0] - width) / 2 - 0.1)
        top = round((input_size[1] - height) / 2 - 0.1)
        return cls(image_size, (left, top, width, height))

    def to_image(self, boxes_input_px: Boxes) -> Boxes:
        """Map (N, 4) boxes from input pixels to image pixels, clipped to the image."""
        left, top, width, height = self.content
        image_width, image_height = self.image_size
        x = (boxes_input_px[:, 0::2] - left) * (image_width / width)
        y = (boxes_input_px[:, 1::2] - top) * (image_height / height)
        boxes = np.empty_like(boxes_input_px)
        boxes[:, 0::2] = np.clip(x, 0, image_width)
        boxes[:, 1::2] = np.clip(y, 0, image_height)
        return boxes


class Letterboxer:
    """Writes images into one reused network input; nothing is allocated while the geometry stays the same.

    ``anchor`` is the place of the image, ``preparation`` the network's value of a pixel, as float32, float16 or, for
    the pixel itself, uint8.
    """

    def __init__(
        self, *, anchor: Anchor, preparation: Preparation, dtype: np.dtype[Any], channels_last: bool = False
    ) -> None:
        self._anchor: Anchor = anchor
        self._rgb = preparation.rgb
        # Tables of 256 values are exact and as fast as a multiplication; float16 passes through OpenCV as its bits.
        pixels = np.arange(256, dtype=np.float32)
        self._tables = [
            _bits(((pixels - np.float32(mean)) * np.float32(scale)).astype(dtype))
            for mean, scale in zip(preparation.mean, preparation.scale, strict=True)
        ]
        self._as_they_are = dtype == np.float32 and all(np.array_equal(one, pixels) for one in self._tables)
        self._dtype = dtype
        self._channels_last = channels_last
        self._input_size = (0, 0)
        self._letterbox: Letterbox | None = None
        self._resized: Image
        self._planes: Image
        self._tensor: npt.NDArray[Any]
        self._last: npt.NDArray[Any]
        self._targets: npt.NDArray[Any]

    def fill(self, image_bgr: Image, input_size: tuple[int, int]) -> tuple[npt.NDArray[Any], Letterbox]:
        """Return the (1, 3, height, width) input, valid until the next call, and how the image lies on it.

        It is (1, height, width, 3) where channels come last.
        """
        image_size = (image_bgr.shape[1], image_bgr.shape[0])
        if (
            self._letterbox is None
            or self._letterbox.image_size != image_size
            or self._input_size != input_size
        ):
            self._lay_out(image_size, input_size)
        assert self._letterbox is not None
        content = self._letterbox.content[2:]
        if content != image_size:
            cv2.resize(image_bgr, content, dst=self._resized, interpolation=cv2.INTER_LINEAR)
            image_bgr = self._resized
        for top in range(0, len(image_bgr), _ROWS_AT_ONCE):
            rows = image_bgr[top : top + _ROWS_AT_ONCE]
            planes = self._planes[:, : len(rows)]
            cv2.split(rows, list(planes))  # a tenth of the time of one channel after the other
            ordered, targets = planes[:: -1 if self._rgb else 1], self._targets[:, top : top + len(rows)]
            if self._as_they_are:  # half the time of tables
                np.copyto(targets, ordered)
                continue
            for plane, table, target in zip(ordered, self._tables, targets, strict=True):
                cv2.LUT(plane, table, dst=target)
        if not self._channels_last:
            return self._tensor, self._letterbox
        np.copyto(self._last, self._tensor.transpose(0, 2, 3, 1))
        return self._last, self._letterbox

    def _lay_out(self, image_size: tuple[int, int], input_size: tuple[int, int]) -> None:
        self._letterbox = Letterbox.fitted(image_size, input_size, anchor=self._anchor)
        self._input_size = input_size
        # The former input goes before the new one comes: 25 MB for a 1080p source.
        self._resized = self._planes = self._tensor = self._last = self._targets = np.empty(0, np.uint8)
        left, top, wide, high = self._letterbox.content
        width, height = input_size
        self._resized = np.empty((0 if (wide, high) == image_size else high, wide, 3), np.uint8)
        self._planes = np.empty((3, min(high, _ROWS_AT_ONCE), wide), np.uint8)
        self._tensor = np.empty((1, 3, height, width), self._dtype)
        for plane, table in zip(_bits(self._tensor)[0], self._tables, strict=True):
            plane[:] = table[_FILL]
        self._targets = _bits(self._tensor)[0, :, top : top + high, left : left + wide]
        if self._channels_last:
            self._last = np.empty((1, height, width, 3), self._dtype)


def _bits(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    # The same memory in a type that OpenCV knows.
    return values.view(np.uint16) if values.dtype == np.float16 else values


def without_palette(image_bgr: Image) -> tuple[Image, bool]:
    """A thermal picture whose palette rises in brightness, such as "iron", in grey; any other as it is.

    And whether it has no colour then. Strong colours that follow from the brightness alone are a palette's.
    """
    some = image_bgr[::8, ::8].reshape(-1, 3)
    colours = np.diff(some.astype(np.float32), axis=1)
    strength = float(np.abs(colours).mean())
    if strength < _PALETTE_COLOUR:
        return image_bgr, strength <= _LEAST_COLOUR
    levels = np.asarray(cv2.cvtColor(some[None], cv2.COLOR_BGR2GRAY), np.uint8).ravel() >> 3
    count = np.maximum(np.bincount(levels, minlength=32), 1)
    means = np.stack([np.bincount(levels, one, 32) / count for one in colours.T], axis=1)
    if (
        np.square(colours - means[levels]).sum()
        > _UNEXPLAINED * np.square(colours - colours.mean(axis=0)).sum()
    ):
        return image_bgr, False
    grey = cv2.cvtColor(image_bgr, cv2.COLOR_BGR2GRAY)
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8), True


def as_bgr(image: npt.NDArray[np.uint8]) -> Image:
    """Return the image as (height, width, 3) BGR: grey is spread over three channels, alpha is dropped.

    Raises `ValueError` where it has no pixels or is no image at all.
    """
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or 0 in image.shape:
        raise ValueError(f"an image of uint8 pixels is expected, not {image.dtype} {image.shape}")
    channels = 1 if image.ndim == 2 else image.shape[2]
    if channels == 3:
        return image
    if channels == 1:
        return np.repeat(image.reshape(*image.shape[:2], 1), 3, axis=2)
    if channels == 4:
        return np.ascontiguousarray(image[:, :, :3])
    raise ValueError(f"an image of 1, 3 or 4 channels is expected, not {channels}")
