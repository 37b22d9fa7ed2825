"""`hevc-intra`: one intra slice of x265, whose headers both sides know."""

from __future__ import annotations

from dataclasses import dataclass, field

from hvt_common.values import Image
from hvt_common.video.still_codecs.av_still import decoded, encoded
from hvt_common.video.still_codecs.contract import NO_PARAMETERS, CodedCrop, Parameters
from hvt_common.video.still_codecs.h264_intra import split_payload
from hvt_common.video.still_codecs.hevc_syntax import CHROMA_QP_OFFSET, cabac_data, coded_picture
from hvt_common.video.still_codecs.ladder import qp_of
from hvt_common.video.still_codecs.yuv420 import padded_size, to_bgr, to_planar

__all__ = ["HevcIntraCodec"]

_LEAST_PX = 32
"""x265 takes no picture that is smaller than a block of its tree."""

# One thread and no thread pool: opening then takes 0.5 ms, not 32. `superfast` finds within 3 % what `slow` finds.
_OPTIONS = (
    "pools=none:frame-threads=1:wpp=0:log-level=none:info=0:keyint=1:ipratio=1:aq-mode=0:psy-rd=0:psy-rdoq=0:"
    "ctu=32:min-cu-size=8:max-tu-size=32:tu-intra-depth=1:sao=0:strong-intra-smoothing=0:signhide=1:amp=0:"
    f"tskip=0:cu-lossless=0:repeat-headers=1:cbqpoffs={CHROMA_QP_OFFSET}:crqpoffs={CHROMA_QP_OFFSET}:qp="
)


@dataclass(frozen=True, slots=True)
class HevcIntraCodec:
    """The payload is one byte with the QP, then the slice's CABAC data."""

    name: str = field(default="hevc-intra", init=False)
    media_type: str = field(default="application/vnd.hvt.hevc-intra", init=False)
    needs_base: bool = field(default=False, init=False)

    def encode(self, crop_bgr: Image, *, quality_pct: int, base_bgr: Image | None = None) -> CodedCrop:  # noqa: ARG002
        """Code a crop; sizes that are no multiple of 16 are filled up with their last row and column."""
        qp, size = qp_of(quality_pct), padded_size((crop_bgr.shape[1], crop_bgr.shape[0]), least_px=_LEAST_PX)
        options = {"preset": "superfast", "tune": "zerolatency", "x265-params": f"{_OPTIONS}{qp}"}
        (unit,) = encoded([to_planar(crop_bgr, least_px=_LEAST_PX)], encoder="libx265", options=options)
        return CodedCrop(bytes([qp]) + cabac_data(unit, size=size, qp=qp))

    def decode(
        self,
        data: bytes,
        *,
        size: tuple[int, int],
        parameters: Parameters = NO_PARAMETERS,  # noqa: ARG002
        base_bgr: Image | None = None,  # noqa: ARG002
    ) -> Image:
        """The crop again; the slice cannot say another size, since its parameter sets are made here."""
        qp, cabac = split_payload(data)
        whole = padded_size(size, least_px=_LEAST_PX)
        unit = coded_picture(cabac, size=whole, qp=qp)
        return to_bgr(decoded([unit], decoder="hevc", size=whole), size=size)
