"""Which codecs of stills all grounds read."""

import logging

from hvt_common.protocol.messages import InfoRequest
from hvt_edge.link.stills import StillReaders
from rigs.examples import Clock

S = 1_000_000_000


def request(requester: int, *codecs: str) -> InfoRequest:
    return InfoRequest(requester_id=requester, still_codecs=codecs)


def read(readers: StillReaders, codecs: str = "jpeg residual avif jxl") -> str:
    return " ".join(filter(readers.read, codecs.split()))


def test_all_grounds_have_to_read_a_codec(caplog):
    """The second screen would stay without stills."""
    readers = StillReaders(Clock(10**18))
    assert read(readers) == "jpeg residual avif jxl", "nobody has said anything"
    for ground, codecs, read_by_all in (
        (1, "jpeg residual avif", "jpeg residual avif"),
        (2, "jpeg avif", "jpeg avif"),
        (2, "jpeg residual", "jpeg residual"),
    ):
        readers.on_request(request(ground, *codecs.split()))
        assert read(readers) == read_by_all
    assert "a ground does not read stills of residual: others are sent while it listens" in caplog.messages


def test_a_ground_that_reads_no_video_of_the_edge_is_told_of(caplog):
    """Its screen would stay black, and nobody would know why."""
    caplog.set_level(logging.WARNING)
    readers = StillReaders(Clock(10**18))
    readers.on_request(request(1, "jpeg"))
    assert caplog.messages == []
    for _ in range(2):
        readers.on_request(InfoRequest(requester_id=2, still_codecs=("jpeg",), base_codecs=("h264", "av1")))
    assert caplog.messages == [
        "a ground reads video of h264, av1: this edge sends h265, and that ground will show none"
    ]


def test_a_ground_that_has_gone_counts_for_a_minute():
    """A look from a phone would cost the bits of all that follows."""
    clock = Clock(10**18)
    readers = StillReaders(clock)
    readers.on_request(request(1, "jpeg"))
    clock.now_ns += 60 * S
    assert read(readers, "residual") == ""
    clock.now_ns += 1
    assert read(readers, "residual") == "residual"


def test_strangers_do_not_fill_the_edge(caplog):
    """Numbers cost their sender nothing: each would take memory, and its codec a line of the log."""
    caplog.set_level(logging.WARNING)
    readers = StillReaders(Clock(10**18))
    readers.on_request(request(0, "jpeg"))
    for number in range(1, 1000):
        readers.on_request(request(number, "jpeg", "residual"))
    assert read(readers, "residual") == "residual", "the oldest has made its place free"
    for number in range(100):
        assert not readers.read(f"codec-{number}")
    assert len(caplog.records) == 8
