"""Lockstep: the same input gives the same bytes, also where the ground's opinion decides what is sent."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import pytest

from programs.processes import Link, agree
from programs.rrd import Recording

pytestmark = [pytest.mark.nightly, pytest.mark.integration, pytest.mark.realdata]

FRAMES = 60

MEASURED = ("session", "encode_ms", "perception_ms", "replies", "reply_bytes")
"""What a run measures of the machine, and how often a ground has asked; all else follows from the input."""


@dataclass(frozen=True)
class Play:
    """One run: both summaries, the recording, and the base stream as it was kept."""

    edge: dict[str, Any]
    ground: dict[str, Any]
    recording: Recording
    base: list[tuple[int | None, bytes]]

    @property
    def stills(self) -> list[bytes]:
        """Every still; when each is shown hangs on when it comes, since stills yield to the base stream."""
        return sorted(still for _, still in self.recording.stills())

    @property
    def account(self) -> dict[str, Any]:
        """The edge's summary without what a run measures of the machine."""
        return {name: value for name, value in self.edge.items() if name not in MEASURED}


def flown(folder: Path, *, edge_settings: tuple[str, ...], ground_settings: tuple[str, ...] = ()) -> Play:
    folder.mkdir()
    with Link(folder) as link:
        # By its speed auto may choose one provider this time and another the next, and their answers differ a little.
        ground = link.ground("--once", "--record", "flight.rrd", "--provider", "cpu", *ground_settings)
        edge = link.edge(
            *("--max-frames", str(FRAMES), "--pace", "lockstep", "--size", "640x360"),
            *("--preset", "ultrafast"),
            *("--record-base", "base.mkv", "--wait", "60s", *edge_settings),
        )
        summaries = edge.finish(), ground.finish()
        agree(*summaries)
    with av.open(str(folder / "base.mkv")) as container:
        base = [(packet.pts, bytes(packet)) for packet in container.demux(video=0) if packet.size]
    return Play(*summaries, recording=Recording(folder / "flight.rrd"), base=base)


def play(data: Path, folder: Path, *ground_settings: str) -> Play:
    """Four seconds of drone_carpark with M3, whose decisions hang on the classifier's confidence."""
    settings = (
        *("--source", str(data / "clips/drone_carpark.mp4"), "--budget", "400kbps", "--method", "M3"),
        *("--detector", str(data / "models/yolov5su_visdrone_640.onnx"), "--cooldown", "1s"),
        *("--min-gain", "1"),
    )
    return flown(folder, edge_settings=settings, ground_settings=ground_settings)


@pytest.fixture(scope="module")
def plays(data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Play, Play, Play]:
    """Twice the same, and once with a ground that has no opinion."""
    folder = tmp_path_factory.mktemp("lockstep")
    opinions = (
        *("--detector", str(data / "models/yolov5su_visdrone_640.onnx"), "--detect-every", "5"),
        *("--classifier", "aerial-cls"),
    )
    return (
        play(data, folder / "one", *opinions),
        play(data, folder / "two", *opinions),
        play(data, folder / "mute", "--classifier", "none"),
    )


def test_the_same_input_gives_the_same_pictures_stills_and_account(plays):
    """No figure of a study could be made again, nor two runs be compared number by number."""
    one, two, _ = plays
    assert len(one.base) == FRAMES
    assert one.base == two.base
    samples = [[unit for _, _, unit in run.recording.video()] for run in (one, two)]
    assert len(samples[0]) == FRAMES
    assert samples[0] == samples[1]
    assert one.edge["stills"]["sent"] == len(one.stills) > 5
    assert one.stills == two.stills
    assert one.account == two.account
    for name in ("tracks", "detections_run", "frames_decoded", "meta_bytes", "worst_window_bps"):
        assert one.ground[name] == two.ground[name], name


def test_the_grounds_opinion_counts(plays):
    """Feedback would be sent and paid for, and change nothing."""
    one, _, mute = plays
    assert mute.base == one.base, "the base stream does not hang on it"
    assert mute.ground["stills"]["unread"] == mute.ground["stills"]["received"] > 0
    assert mute.stills != one.stills


def test_what_auto_decides_is_the_same_and_stands_in_the_recording(tmp_path: Path):
    """It goes by what the ground reports it sees; and nobody could tell from a recording why there were no tracks."""
    runs = []
    for name, seen in (("one", "aerial-nano"), ("two", "aerial-nano"), ("blind", "motion")):
        settings = ("--source", "demo", "--budget", "2000kbps", "--provider", "cpu")
        ground = ("--detector", seen, "--classifier", "none")
        runs.append(flown(tmp_path / name, edge_settings=settings, ground_settings=ground))
    one, two, blind = runs
    assert one.base == two.base
    assert one.account == two.account
    said = [[text for _, _, text in run.recording.events() if "tracks: " in text] for run in runs]
    assert said[0] == said[1]
    assert said[0][0].split(": ")[0] in ("The edge sends its tracks", "The edge sends no tracks")
    hidden = [int(re.search(r"(\d+) object", run.edge["decisions"])[1]) for run in runs]
    assert "the ground misses" in blind.edge["decisions"]
    assert hidden[2] > 3 * hidden[0] > 0
    assert blind.ground["tracks"] > 0
