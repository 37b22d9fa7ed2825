"""What a still codec is: a crop to bytes at the edge, the bytes back to a crop at the ground.

A codec is a frozen value without state that may be used by several threads. Its ``decode`` is fed by the network, so
it looks at the dimensions in the header before it decodes a single block, and answers anything it does not like with
`StillError`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Protocol

from hvt_common.values import Image

__all__ = ["NO_PARAMETERS", "BaseMissingError", "CodedCrop", "Parameters", "StillCodec", "StillError"]

Parameters = Mapping[str, int | float | str]
"""At most 5 of them, keys of at most 16 bytes: they cross the link in the still's header, and cost bytes there."""

NO_PARAMETERS: Parameters = MappingProxyType({})
"""Nothing beside the bytes."""


class StillError(Exception):
    """A still that cannot be decoded: truncated, of another format than announced, or of another size."""


class BaseMissingError(StillError):
    """The still builds on a base picture that is not at hand, or not the one that the edge had."""


@dataclass(frozen=True, slots=True)
class CodedCrop:
    """A crop as bytes, and what the other side has to know beside them."""

    data: bytes
    parameters: Parameters = field(default_factory=dict)


class StillCodec(Protocol):
    """What the edge and the ground ask of a codec."""

    @property
    def name(self) -> str:
        """The word on the wire, ``[a-z0-9-]``, at most 24 characters."""
        ...

    @property
    def media_type(self) -> str:
        """``image/jpeg`` and the like; also the Zenoh encoding of the payload."""
        ...

    @property
    def needs_base(self) -> bool:
        """Whether ``base_bgr`` has to be given: what the decoded base frame shows of the crop, at the same size."""
        ...

    def encode(self, crop_bgr: Image, *, quality_pct: int, base_bgr: Image | None = None) -> CodedCrop:
        """Code a crop of at least 1x1 pixels; ``quality_pct`` runs from 1 (smallest) to 100 (best).

        More quality never means a worse picture; it nearly always means more bytes.
        """
        ...

    def decode(
        self,
        data: bytes,
        *,
        size: tuple[int, int],
        parameters: Parameters = NO_PARAMETERS,
        base_bgr: Image | None = None,
    ) -> Image:
        """The crop again, BGR, exactly ``size`` (width, height).

        Raises `StillError` for anything hostile, before it costs more than a picture of that size; `BaseMissingError`
        where ``base_bgr`` is needed and is None or another than the edge had.
        """
        ...
