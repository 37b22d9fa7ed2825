"""A camera that makes HEVC itself, through edge, Zenoh and ground: what is recorded is what it made."""

import pytest

import hvt_edge.cli
from hvt_common.video.hevc import BaseDecoder, nal_kind, nal_units, parameter_sets
from hvt_ground.control import EdgeClient, RefusedError
from media.clips import hard_pictures, smooth_pictures
from media.hevc_camera import SIZE, packets_of, pictures_of, write_clip
from programs.processes import Link, Running, eventually
from programs.rrd import Recording

pytestmark = pytest.mark.integration
FLIGHT = "passthrough"


def camera(clip: object) -> tuple[str, ...]:
    return ("--source", str(clip), "--encoder", "passthrough", "--detector", "motion", "--wait", "60s")


def with_camera(link: Link, clip: object, *settings: str) -> Running:
    return link.edge(*camera(clip), *settings)


def ground_of(link: Link) -> Running:
    return link.ground("--once", "--record", "flight.rrd", "--classifier", "none", "--detector", "motion")


@pytest.mark.parametrize(
    ("name", "more"),
    [
        pytest.param("camera.hevc", "", marks=pytest.mark.nightly),
        ("camera.ts", "aud=1:repeat-headers=1"),
        pytest.param("camera.mp4", "", marks=pytest.mark.nightly),
        pytest.param("camera.mkv", "open-gop=1", marks=pytest.mark.nightly),
    ],
)
def test_the_recording_holds_the_cameras_own_units(link, name, more):
    """A camera's good picture would be coded a second time, and lose by it, or not be shown at all."""
    clip = write_clip(link.folder / name, more=more)
    ground = ground_of(link)
    edge = with_camera(link, clip, "--pace", "lockstep", "--budget", "400kbps", "--record-base", "copy.mkv")
    sent, received = edge.finish(), ground.finish()
    assert "is passed through: 15 fps, " in edge.said
    assert sent["frames"] == received["frames_decoded"] == 45
    assert sent["worst_window_bps"]["total"] <= 400_000
    recorded = [data for _, _, data in Recording(link.folder / "flight.rrd").video()]
    if clip.suffix in (".hevc", ".ts"):
        assert recorded == packets_of(clip)
    slices = [[nal for nal in nal_units(unit) if nal_kind(nal) < 32] for unit in recorded]
    assert slices == pictures_of(clip)
    assert [index for index, unit in enumerate(recorded) if parameter_sets(unit)] == [0, 10, 20, 30, 40]
    for first in (0, 20):  # who joins there
        decoder = BaseDecoder(size=SIZE)
        assert all(decoder.decode(unit) is not None for unit in recorded[first:])
    assert pictures_of(link.folder / "copy.mkv") == slices


@pytest.mark.nightly
def test_a_closer_look_and_a_keyframe_are_refused_with_their_reasons(link):
    """Bits would go to a still of the pixels that the video has; whoever joins would ask for a keyframe for ever."""
    pictures = smooth_pictures(10, size=SIZE) * 30  # for longer than anything is waited for
    clip = write_clip(link.folder / "camera.mp4", pictures, keyint=2, fps=1)
    ground = ground_of(link)
    edge = with_camera(link, clip, "--still-codec", "residual", "--edge-id", "uav-1")
    eventually(lambda: "uav-1" in ground.said and "kbps" in ground.said, what="it is received")
    said: list[str] = []

    def refused() -> bool:
        with pytest.raises(RefusedError) as caught:
            client.still(box=(40, 40, 100, 80), quality_pct=90)
        said.append(str(caught.value))
        return "the video already shows it as well as the source does" in said[-1]

    with EdgeClient.connect(link.ground_endpoint) as edges:
        client = edges["uav-1"]
        eventually(refused, what="a still has nothing to add")
        with pytest.raises(RefusedError, match=r"makes no keyframe on request: .* one each 2\.0 s or so"):
            client.keyframe()
    edge.stop()
    sent, received = edge.finish(), ground.finish()
    assert sent["stills"]["sent"] == received["stills"]["received"] == 0
    assert sent["frames"] == received["frames_decoded"] > 0


@pytest.mark.parametrize(
    ("source", "settings", "says"),
    [
        ({"more": "qp=20"}, ("--budget", "200kbps"), " kbps for it: re-encode it with --encoder x265"),
        ({"bframes": 2}, (), "(B-frames)"),
        ({"codec": "libx264"}, (), "is h264"),
        ({}, ("--size", "640x360"), "is 320x192, --size is 640x360"),
        ({}, ("--size", "auto"), "--size auto is not accepted with --encoder passthrough"),
        ({}, ("--fps", "10"), "gives 15 frames a second, --fps is 10"),
        ({}, ("--video-share", "auto"), "--video-share auto is not accepted"),
        ({}, ("--roi-depth", "0.1"), "--encoder passthrough takes no regions"),
        ("demo", (), "'demo' is the drawn demo"),
    ],
)
def test_what_cannot_be_passed_through_is_one_sentence(tmp_path, capsys, source, settings, says):
    """A traceback, or a flight whose picture is garbage or left out, in place of what to change."""
    if isinstance(source, dict):
        source = write_clip(tmp_path / "camera.mp4", hard_pictures(45, size=SIZE), **source)
    assert hvt_edge.cli.main(["--connect", "tcp/127.0.0.1:9", *camera(source), *settings]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("hvt-edge: ")
    assert says in line
