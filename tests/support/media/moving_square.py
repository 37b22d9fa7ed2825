"""A square that moves, coded with real encoders."""

from fractions import Fraction
from typing import cast

import av
import numpy as np
from av.video.codeccontext import VideoCodecContext

SIZE, FPS, STEP_PX = (320, 192), 15, 4


def moving_square(codec: str, count: int) -> list[tuple[bytes, bool]]:
    """Annex B access units, and whether each is a keyframe: the first alone is one."""
    encoder = cast("VideoCodecContext", av.CodecContext.create(codec, "w"))
    encoder.width, encoder.height = SIZE
    encoder.pix_fmt = "yuv420p"
    encoder.time_base = Fraction(1, FPS)
    encoder.options = {"preset": "ultrafast", "tune": "zerolatency", "g": "600"}
    if codec == "libx265":
        encoder.options |= {"x265-params": "log-level=none:repeat-headers=1:keyint=600:bframes=0"}
    packets = []
    for index in range(count):
        picture = np.full((SIZE[1], SIZE[0], 3), 60, np.uint8)
        picture[50:90, index * STEP_PX : index * STEP_PX + 40] = (40, 200, 220)
        frame = av.VideoFrame.from_ndarray(picture, format="bgr24")
        frame.pts = index
        packets += encoder.encode(frame)
    return [(bytes(packet), packet.is_keyframe) for packet in packets + encoder.encode(None)]
