"""A still codec, a detector, encoders that HVT has never heard of, installed beside it, through the pipeline."""

import os
import sys
from pathlib import Path

import pytest

from media.third_party import BLOBS, ENCODERS, install
from programs.processes import Link, Running
from programs.rrd import Recording

pytestmark = pytest.mark.integration
FLIGHT = "plug-ins"

FRAMES = 60


STILLS = ("--budget", "1200kbps", "--method", "M5", "--cooldown", "1s")
"""Of everything that moves."""


def ground_of(link: Link, detector: str = "aerial-nano") -> Running:
    return link.ground("--once", "--record", "flight.rrd", "--classifier", "none", "--detector", detector)


def edge_of(link: Link, scene: Path, *settings: str) -> Running:
    return link.edge(
        *("--source", str(scene), "--fps", "10", "--max-frames", str(FRAMES), "--pace", "lockstep"),
        *("--size", "640x360", "--preset", "ultrafast", "--detector", "motion", "--wait", "60s", *settings),
    )


@pytest.fixture
def acme(tmp_path, monkeypatch) -> None:
    """Every process that starts now has the package installed."""
    folder = install(tmp_path / "site", {"acme-pixels": "PixelCodec"})
    install(folder, {"acme-blobs": "BlobDetector"}, module="acme_blobs", source=BLOBS, group="hvt.detectors")
    encoders = {f"acme-{one.lower()}": one for one in ("Obedient", "Greedy")}
    install(folder, encoders, module="acme_encoders", source=ENCODERS, group="hvt.encoders")
    old = os.environ.get("PYTHONPATH")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(folder), *([old] if old else [])]))


@pytest.mark.nightly
def test_a_ground_without_the_codec_gets_jpeg(link, scene, acme, monkeypatch):
    """One unknown codec would take the operator's stills away, or the whole picture."""
    with_codec = os.environ["PYTHONPATH"]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(with_codec.split(os.pathsep)[1:]))
    ground = ground_of(link)
    monkeypatch.setenv("PYTHONPATH", with_codec)
    edge = edge_of(link, scene, *STILLS, "--still-codec", "acme-pixels")
    sent, seen = edge.finish(), ground.finish()
    assert sent["stills"]["sent"] > 5
    assert seen["frames_decoded"] == FRAMES
    stills = [data for _, data in Recording(link.folder / "flight.rrd").stills()]
    assert len(stills) > 5, "it has said what it reads"
    assert {data[:2] for data in stills} == {b"\xff\xd8"}, "JPEG"


def test_the_package_is_found_by_its_metadata_alone(acme):
    """The test itself would prove nothing, were the module imported in another way."""
    assert "acme_codecs" not in sys.modules


def test_a_codec_and_a_detector_of_others_fly(link, scene, acme):
    """A better codec of tomorrow, TensorRT, RKNN, Hailo or NCNN would need a fork of HVT on both sides."""
    detector = "acme-blobs:person,crate"
    seeing = ground_of(link, detector)
    flying = edge_of(link, scene, *STILLS, "--detector", detector, "--still-codec", "acme-pixels")
    edge, ground = flying.finish(), seeing.finish()
    assert edge["stills"]["sent"] == ground["stills"]["received"] > 5
    assert edge["roi_bytes"] == ground["roi_bytes"] > 0
    assert ground["tracks"] > 2
    recording = Recording(link.folder / "flight.rrd")
    assert len(recording.stills()) >= 5
    shown = {box.class_after for frame in range(FRAMES) for box in recording.boxes(frame).values()}
    assert set() < shown <= {"person", "crate"}


@pytest.mark.parametrize(("name", "lowered"), [("acme-obedient", False), ("acme-greedy", True)])
@pytest.mark.nightly
def test_another_encoder_flies_within_the_budget(link, scene, acme, name, lowered):
    """Who has an encoder in his board would need a fork of HVT, or one that takes more than it says would be late."""
    ground = ground_of(link, "motion")
    edge = edge_of(link, scene, "--budget", "300kbps", "--encoder", name)
    sent, received = edge.finish(), ground.finish()
    assert sent["frames"] == received["frames_decoded"] == FRAMES, "the clip begins anew after the run"
    assert sent["worst_window_bps"]["total"] <= 300_000
    assert (f"encoder {name} overshoots: it is set to" in edge.said) == lowered
