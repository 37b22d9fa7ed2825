"""Encoders of hardware: refused in a sentence where the device is not there; what stands behind their rows codes."""

from __future__ import annotations

import pytest

from hvt_codecs.hardware import ROWS, HardwareEncoder, HardwareRow
from hvt_common.errors import UserError
from hvt_common.video.hevc import BaseDecoder, nal_kind, nal_units
from hvt_edge.video.encoder import CheckedEncoder, EncoderSettings, open_encoder
from media.clips import framed, smooth_pictures

SIZE = (320, 192)
SETTINGS = EncoderSettings(size=SIZE, fps=15.0, bitrate_bps=200_000, preset="ultrafast")
FRAMES = framed(smooth_pictures(6, size=SIZE))


def coded(encoder, *, keyframes):
    return [encoder.encode(frame, keyframe=frame.index in keyframes) for frame in FRAMES]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.codec)
def test_hardware_that_is_not_there_is_refused(row):
    """An edge would end with FFmpeg's internals, or fly without video."""
    try:
        open_encoder(row.codec, SETTINGS)
    except UserError as error:
        text = str(error)
    else:
        pytest.skip(f"this machine has {row.needs}")
    assert text.startswith(f"--encoder {row.codec} does not open on this machine (")
    assert text.endswith(f": it takes {row.needs}; x265 takes none")


def test_the_class_behind_the_rows_codes():
    """Nothing of it would have run before the first flight with a GPU; here x265 stands behind a row of its own."""
    options = {"preset": "ultrafast", "tune": "zerolatency", "forced-idr": "1"}
    options["x265-params"] = "log-level=none:repeat-headers=1:open-gop=0:bframes=0:min-keyint=1"
    row = HardwareRow("libx265", "yuv420p", "nothing", options)
    encoder, decoder = HardwareEncoder(SETTINGS, row=row), BaseDecoder(size=SIZE)
    for frame, unit in zip(FRAMES, coded(encoder, keyframes=(0, 4)), strict=True):
        assert unit.keyframe == (frame.index in (0, 4))
        assert abs(decoder.decode(unit.data).astype(int) - frame.base_bgr).mean() < 8
    assert 0 < encoder.mean_qp < 51


def test_filler_is_left_out():
    """A rate that a still scene does not need would be sent all the same."""
    params = (
        "log-level=none:repeat-headers=1:bframes=0:rc-lookahead=0:strict-cbr=1:vbv-maxrate=200:vbv-bufsize=30"
    )
    options = {"preset": "ultrafast", "tune": "zerolatency", "x265-params": params}
    row, sizes = HardwareRow("libx265", "yuv420p", "nothing", options), []
    for encoder in (HardwareEncoder(SETTINGS, row=row), CheckedEncoder(HardwareEncoder(SETTINGS, row=row))):
        units = [encoder.encode(frame) for frame in framed(smooth_pictures(1, size=SIZE) * 15)]
        sizes.append(sum(len(unit.data) for unit in units[1:]))
        kinds = {nal_kind(nal) for unit in units for nal in nal_units(unit.data)}
        assert (38 in kinds) is (len(sizes) == 1)
    assert sizes[1] < 0.5 * sizes[0]


def test_a_row_of_hardware_that_delays_is_an_error():
    """Pictures would be older than their times say."""
    row = HardwareRow("libx265", "yuv420p", "nothing", {"x265-params": "log-level=none"})
    with pytest.raises(ValueError, match="libx265 gave 0 units for frame 0: it delays"):
        coded(HardwareEncoder(SETTINGS, row=row), keyframes=(0,))
