"""What the ground asks for, as bytes: the blocks of each frame of a segment.

``>IB``: first frame of the segment and number of frames, then the masks one after the other as bits, each but the
first as its difference (exclusive or) from the one before, deflated. Regions that stay cost next to nothing.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import numpy as np

from hvt_study.peers.dds_regions import Blocks

_HEAD = struct.Struct(">IB")
_LEVEL = 9


@dataclass(frozen=True, slots=True)
class RegionRequest:
    """One question of the ground."""

    first_frame: int
    """Of the segment."""
    frames: tuple[Blocks, ...]
    """Of every coded frame of the segment in order, 1 to 255; empty masks where nothing is asked."""

    def pack(self) -> bytes:
        """The payload."""
        stack = np.stack(self.frames)
        stack[1:] ^= np.stack(self.frames)[:-1]
        return _HEAD.pack(self.first_frame, len(stack)) + zlib.compress(np.packbits(stack).tobytes(), _LEVEL)

    @classmethod
    def parse(cls, payload: bytes, *, grid: tuple[int, int]) -> RegionRequest:
        """Read it; ``grid`` is (rows, columns) of this session.

        Raises:
            ValueError: it is not one of this session.
        """
        if len(payload) < _HEAD.size:
            raise ValueError(f"a request of {len(payload)} bytes is cut off")
        first_frame, count = _HEAD.unpack_from(payload)
        cells = count * grid[0] * grid[1]
        expected = -(-cells // 8)
        try:
            bits = zlib.decompressobj().decompress(payload[_HEAD.size :], expected + 1)
        except zlib.error as error:
            raise ValueError(f"a request cannot be inflated: {error}") from None
        if len(bits) != expected or not count:
            raise ValueError(f"a request for {count} frames holds {len(bits)} bytes of masks, not {expected}")
        changes = np.unpackbits(np.frombuffer(bits, np.uint8), count=cells).reshape(count, *grid)
        return cls(first_frame, tuple(np.bitwise_xor.accumulate(changes, axis=0).astype(np.bool_)))
