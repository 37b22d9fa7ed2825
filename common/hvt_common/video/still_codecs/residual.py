"""`residual`: the difference between the crop and the decoded base, which both sides have alike.

The base crop is the reference picture of one inter-coded H.264 slice. At the edge x264 gets the base crop as its
first picture, nearly lossless, and the source as its second; only the second's slice data crosses the link. The
ground writes the base crop as a picture of verbatim samples (I_PCM) in front of it. So x264 chooses block by block:
the base as it is (next to nothing), the base plus a difference, the base from a little aside, or the source anew.

The ground adds only the decoded difference to its base crop: where nothing was coded the result is the base,
to the bit. All of it is arithmetic of whole numbers (docs/wire-stills.md). A checksum reveals another base before
anything is painted.
"""

import zlib

import numpy as np

from hvt_common.values import Image
from hvt_common.video.still_codecs.contract import (
    NO_PARAMETERS,
    BaseMissingError,
    CodedCrop,
    Parameters,
    qp_of,
)
from hvt_common.video.still_codecs.h264_intra import (
    cabac_data,
    coded_slice,
    decoded,
    encoded,
    parameter_sets,
    split_payload,
    verbatim_picture,
    x264_options,
)
from hvt_common.video.still_codecs.yuv420 import (
    Planar,
    difference_bgr,
    filled_outside,
    padded_size,
    to_planar,
)

CHECKSUM = "b"
"""The parameter with the low 16 bits (recordings may have all) of the CRC-32 of the reference: the base crop's
planes Y, Cb and Cr, whole blocks."""

_REFERENCE_QP = 4
"""The base crop in x264: within 0.3 levels of the base itself."""


class ResidualCodec:
    """The payload is one byte with the QP, then the slice's CABAC data."""

    name = "residual"
    media_type = "application/vnd.hvt.residual"
    needs_base = True
    step_of = staticmethod(qp_of)

    def encode(self, crop_bgr: Image, *, quality_pct: int, base_bgr: Image | None = None) -> CodedCrop:
        """Code the difference of the crop to ``base_bgr``, which has its shape."""
        if base_bgr is None or base_bgr.shape != crop_bgr.shape:
            raise BaseMissingError(
                f"a residual of a crop of {crop_bgr.shape} needs a base crop of that shape"
            )
        height, width = crop_bgr.shape[:2]
        base = to_planar(base_bgr)
        # Beyond the crop there is nothing to say: 8 to 17 % fewer bytes than repeating its edge.
        source = filled_outside(to_planar(crop_bgr), base, size=(width, height))
        qp = qp_of(quality_pct)
        ratio = 2 ** ((qp - _REFERENCE_QP) / 6)
        options = x264_options(f"qp={qp}:ipratio={ratio:.5f}:keyint=infinite", pixels=width * height)
        units = encoded([base, source], encoder="libx264", options=options)
        cabac = cabac_data(b"".join(units), qp=qp, intra=False)
        return CodedCrop(bytes([qp]) + cabac, {CHECKSUM: _checksum(base)})

    def decode(
        self,
        data: bytes,
        *,
        size: tuple[int, int],
        parameters: Parameters = NO_PARAMETERS,
        base_bgr: Image | None = None,
    ) -> Image:
        """The crop again, on the base crop that the edge had; `BaseMissingError` on any other."""
        if base_bgr is None or base_bgr.shape != (size[1], size[0], 3):
            raise BaseMissingError(f"a residual still of {size[0]}x{size[1]} has no base crop of that size")
        base = to_planar(base_bgr)
        known = parameters.get(CHECKSUM)
        if not isinstance(known, int) or known & 0xFFFF != _checksum(base):
            raise BaseMissingError("a residual still builds on another base picture than the one at hand")
        qp, cabac = split_payload(data)
        whole = padded_size(size)
        units = [parameter_sets(whole) + verbatim_picture(base), coded_slice(cabac, qp=qp, intra=False)]
        picture = decoded(units, decoder="h264", size=whole)
        sharper = base_bgr + difference_bgr(picture, base, size=size)
        return np.asarray(np.clip(sharper, 0, 255), np.uint8)


def _checksum(base: Planar) -> int:
    return zlib.crc32(base.tobytes()) & 0xFFFF
