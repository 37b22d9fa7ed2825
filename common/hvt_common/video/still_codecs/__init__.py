"""Still codecs behind one small contract (`contract.py`); docs/stills.md has the table of them.

A new one is a file beside these and a row at the end of `contract`, or an entry point of a package, as those of the
extra `hvt_codecs`, which no profile uses. Who makes vectors of stills reaches into `h264_intra` and `yuv420`; codecs
reach into `contract`.
"""

from hvt_common.video.still_codecs.contract import (
    NO_PARAMETERS,
    BaseMissingError,
    CodedCrop,
    Parameters,
    StillCodec,
    StillError,
    still_codec,
    still_codec_names,
)
from hvt_common.video.still_codecs.jpeg import JpegCodec
from hvt_common.video.still_codecs.search import best_fitting, psnr_y_db, smallest_reaching
