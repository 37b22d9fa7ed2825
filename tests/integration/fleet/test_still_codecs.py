"""Edge and ground agree on the codecs of stills, over real Zenoh."""

from __future__ import annotations

import pytest
import zenoh

from hvt_common.protocol.messages import Info, InfoRequest, RoiHeader
from programs.outsider import Tap, answer, joined
from programs.processes import Link, eventually

pytestmark = [pytest.mark.nightly, pytest.mark.integration]

EDGE = (
    *("--source", "demo", "--edge-id", "uav-1", "--size", "640x360", "--fps", "5", "--preset", "ultrafast"),
    *("--budget", "400kbps", "--video-share", "0.6", "--method", "permissive", "--gate", "0", "--wait", "0s"),
    *("--still-codec", "residual", "--fallback-codec", "h264-intra", "--pace", "realtime"),
)


def info(session: zenoh.Session, *codecs: str, requester: int) -> Info:
    """What the edge answers to a ground that reads these codecs."""
    request = InfoRequest(requester_id=requester, still_codecs=codecs)
    return Info.parse(answer(session, "hvt/uav-1/info", request.pack()) or b"")


def test_an_edge_sends_only_what_every_ground_reads(tmp_path):
    """A ground without the codec would show no still, and all of their bits would be for nothing."""
    with Link(tmp_path) as link:
        edge = link.edge(*EDGE, listens=True)
        edge.until("no ground yet")
        with joined(link.edge_endpoint) as session:
            eventually(lambda: answer(session, "hvt/uav-1/info"), what="the edge answers info")
            said = Info.parse(answer(session, "hvt/uav-1/info") or b"")
            assert said.still_codecs == ("residual", "h264-intra")
            assert said.channels == ("base", "roi", "status")
            for channel in ("base", "status"):
                Tap(session, f"hvt/uav-1/{channel}")
            stills = Tap(session, "hvt/uav-1/roi")

            def codecs_after(count: int) -> list[str]:
                headers = [RoiHeader.parse(one.attachment, one.payload) for one in stills.messages]
                return [one.codec for one in headers][count:]

            assert info(session, "jpeg", "h264-intra", "residual", requester=1).still_codecs == (
                "residual",
                "h264-intra",
            )
            eventually(lambda: "residual" in codecs_after(0), what="a residual still")
            assert info(session, "jpeg", requester=2).still_codecs == ("jpeg",)
            before = len(stills.messages)
            # One may be on its way when the second ground asks.
            eventually(lambda: len(codecs_after(before)) > 5, what="stills for both grounds")
            assert set(codecs_after(before)[1:]) == {"jpeg"}
            assert info(session, "jpeg", "h264-intra", requester=2).still_codecs == ("h264-intra",)
        edge.stop()
        assert "a ground does not read stills of residual: others are sent while it listens" in edge.said
