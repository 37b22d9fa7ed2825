"""What is asked of x265, and what it then puts on the line."""

import pytest

from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.protocol.ledger import overhead_bytes
from hvt_edge.link.budget import BASE_ATTACHMENT_BYTES
from hvt_edge.video.encoder import (
    STATUS_BYTES,
    EncoderSettings,
    encoder_settings,
    least_base_bps,
    minimum_bps,
)
from hvt_edge.video.x265 import BaseEncoder
from media.clips import framed, hard_pictures

SIZE, FPS = (640, 360), 15
KEYFRAMES = (20, 46, 95, 125)
"""A second or more apart."""


def asked(base_bps: int, total_bps: int, *, fps: float = FPS) -> EncoderSettings:
    """The encoder's settings for a budget."""
    rates = {"total_bps": total_bps, "base_bps": base_bps}
    return encoder_settings(size=SIZE, fps=fps, preset="veryfast", edge_id="edge-1", **rates)


def line_bits(pictures, settings: EncoderSettings, *, keyframes=KEYFRAMES) -> list[int]:
    """Bits on the line of each frame's message, and of the status once a second."""
    encoder, key = BaseEncoder(settings), EdgeKeys("edge-1")
    bits = []
    for frame in framed(pictures):
        data = encoder.encode(frame, keyframe=frame.index in keyframes).data
        header = BASE_ATTACHMENT_BYTES - 8
        around = header + overhead_bytes(len(data), header, key=key[Channel.BASE], encoding="video/h265")
        if frame.index % FPS == 0:
            around += STATUS_BYTES + overhead_bytes(STATUS_BYTES, 0, key=key[Channel.STATUS])
        bits.append(8 * (len(data) + around))
    return bits


def fullest_second(bits: list[int]) -> int:
    """Most bits in any second."""
    return max(sum(bits[start : start + FPS]) for start in range(len(bits) - FPS + 1))


@pytest.mark.parametrize(("base_bps", "count"), [(100_000, 100), (400_000, 60)])
def test_the_base_stays_within_its_share(base_bps, count):
    """Stills would pay for what the base overspends, or the picture would come late."""
    bits = line_bits(hard_pictures(count, size=SIZE), asked(base_bps, round(base_bps / 0.8125)))
    assert 0.88 * base_bps <= sum(bits) / (count / FPS) <= 1.02 * base_bps
    assert fullest_second(bits) <= 1.15 * base_bps


def test_video_alone_stays_within_the_total():
    """In M0 there are no stills that could yield: each burst would make the picture late."""
    bits = line_bits(hard_pictures(60, size=SIZE), asked(250_000, 250_000))
    assert fullest_second(bits) <= 1.08 * 250_000
    assert sum(bits) / 4 >= 0.74 * 250_000


def test_headers_and_status_are_taken_off_the_target():
    """The stream would exceed its share by what Zenoh and TCP add."""
    settings = asked(650_000, 800_000)
    assert 600_000 < settings.bitrate_bps < 625_000
    assert settings.vbv_s == 0.15
    tight = asked(800_000, 800_000)
    assert tight.vbv_s < 0.15
    assert tight.bitrate_bps < 0.97 * 800_000


def test_the_least_share_leaves_x265_its_minimum():
    """A budget would be accepted of which headers leave less than a picture needs."""
    least = least_base_bps(SIZE, FPS, edge_id="edge-1")
    assert asked(least, 2 * least).bitrate_bps >= 0.99 * minimum_bps(SIZE, FPS)
    assert least < 100_000


def test_the_least_share_is_kept():
    """The smallest budget that is accepted would be overspent in every second."""
    least = least_base_bps(SIZE, FPS, edge_id="edge-1")
    bits = line_bits(hard_pictures(150, size=SIZE), asked(least, 2 * least), keyframes=(100,))
    assert sum(bits) / (150 / FPS) <= 1.05 * least


@pytest.mark.parametrize("decimation", [3, 5])
def test_fewer_frames_leave_more_for_each_and_keep_the_share(decimation):
    """With ``--fps auto`` the base would overspend, or waste what headers no longer take."""
    fps = FPS / decimation
    settings = asked(120_000, 150_000, fps=fps)
    assert settings.bitrate_bps > asked(120_000, 150_000).bitrate_bps + 3_000
    assert settings.vbv_s * fps >= 1.1, "with a VBV of one frame x265 leaves a third of the rate unused"
    pictures = hard_pictures(210, size=SIZE)[::decimation]
    encoder = BaseEncoder(settings)
    payload = sum(len(encoder.encode(frame).data) for frame in framed(pictures, fps=fps))
    header = len(pictures) * 110
    assert 0.75 * 120_000 <= 8 * (payload + header) / (len(pictures) / fps) <= 1.03 * 120_000
    assert least_base_bps(SIZE, fps, edge_id="edge-1") < 0.6 * least_base_bps(SIZE, FPS, edge_id="edge-1")
