"""Asking a flying edge for more, through the ground that watches it, from the command line and from Python."""

import time
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from hvt_ground.cli import main
from hvt_ground.control import EdgeClient, EdgeTrack, RefusedError, RequestedStill
from programs.processes import Link, agree, eventually

pytestmark = pytest.mark.integration

PLACE = (300, 100, 200, 150)
"""x, y, width, height in source pixels."""


def refusal(ask) -> str:
    with pytest.raises(RefusedError) as caught:
        ask()
    return str(caught.value)


def command(*words: str) -> tuple[int, str, str]:
    """``hvt-ground`` with these words: its exit code and both outputs."""
    with redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as err:
        code = main([*words])
    return code, out.getvalue(), err.getvalue()


def held(*words: str) -> tuple[int, str, str]:
    """The same, given again where the edge has analyzed nothing for the seconds that it remembers."""
    found = []

    def asked() -> bool:
        found.append(command(*words))
        return "frames go back" not in found[-1][2]

    eventually(asked, what="the edge holds the frame that is asked for")
    return found[-1]


def patiently(ask: Callable[[], Any], *, while_says: str) -> Any:
    """What it answers, if need be at another try: of more than 32 questions a second the edge refuses some."""
    found: list[Any] = []

    def asked() -> bool:
        time.sleep(0.1)
        try:
            found.append(ask())
        except RefusedError as error:
            if while_says not in str(error):
                raise
        return bool(found and found[-1])

    eventually(asked, what="the edge has what is asked for")
    return found[-1]


def first_track(edge) -> tuple[list[EdgeTrack], RequestedStill] | None:
    """The list of tracks and a still of its first."""
    tracks = edge.tracks()
    return (tracks, edge.still(track=tracks[0].track_id)) if tracks else None


@pytest.fixture(scope="module")
def flight(long_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """An edge in real time, a ground that records, and somebody who asks through the ground."""
    folder = tmp_path_factory.mktemp("asked")
    with Link(folder, name="asked") as link:
        ground = link.ground(
            "--record", "flight.rrd", "--once", "--detector", "motion", "--classifier", "none"
        )
        edge = link.edge(
            *("--source", str(long_scene), "--source-fps", "10", "--fps", "10", "--size", "640x360"),
            *("--preset", "ultrafast", "--budget", "500kbps", "--video-share", "0.6", "--edge-id", "uav-1"),
            *("--method", "M5", "--detector", "motion", "--still-codec", "residual", "--cooldown", "0s"),
        )
        eventually(lambda: "stills" in ground.said, what="the ground sees stills")
        with EdgeClient.connect(link.ground_endpoint) as edges:
            one = edges["uav-1"]
            names = edges.names()
            box = one.still(box=PLACE, quality_pct=90)
            ago = lambda: one.still(box=PLACE, at_s=-2, quality_pct=90)  # noqa: E731
            past = patiently(ago, while_says="frames go back")  # it has not flown for so long
            tracks, track = patiently(lambda: first_track(one), while_says="no track")  # it is lost already
            refusals = [
                refusal(lambda: one.still(track=99999)),
                refusal(lambda: one.still(at_s=-600)),
                refusal(lambda: one.still(box=(900, 500, 100, 100))),
                refusal(lambda: one.set_budget(10_000)),
                refusal(lambda: one.set_method("M99")),
            ]
            before = one.info().budget_bps
            one.keyframe()
            one.set_budget(300_000)
            after = one.info().budget_bps
        connect = ("--connect", link.ground_endpoint)
        out = ("--out", str(folder / "a.png"))
        told = held("still", *connect, "--box", "300,100,200,150", "--at", "-1s", *out)
        nobody = command("keyframe", *connect, "--edge", "uav-2")
        edge.stop()
        found = {"names": names, "box": box, "past": past, "track": track, "tracks": tracks, "told": told}
        found |= {"refusals": refusals, "kbps": (before // 1000, after // 1000), "nobody": nobody}
        return SimpleNamespace(folder=folder, edge=edge.finish(), ground=ground.finish(), **found)


def shows(long_scene: Path, index: int, picture: np.ndarray) -> bool:
    """Whether a picture of the place is of that source frame, and not of one beside it that looks otherwise."""
    x, y, w, h = PLACE
    likeness = {
        one: cv2.PSNR(picture, cv2.imread(str(long_scene / f"{one:06d}.jpg"))[y : y + h, x : x + w])
        for one in range(max(0, index - 2), index + 3)
    }
    return likeness[index] > max(20, max(likeness.values()) - 0.2)


def test_the_still_shows_the_source_frame_that_it_names(flight, long_scene):
    """The operator would look closer at something else, or at what the video stream left of it."""
    assert flight.names == ["uav-1"]
    for still in (flight.box, flight.past):
        assert still.header.crop_source_px == (300, 100, 500, 250)
        assert shows(long_scene, still.header.frame_index, still.image_bgr)


def test_two_seconds_ago_is_two_seconds_ago(flight):
    """The moment that mattered would not be the one that is shown."""
    delay_ns = flight.past.header.send_ns - flight.past.header.capture_ns
    assert delay_ns > 0.5e9, "the nearest frame there is: a busy machine may have left out those around it"


def test_a_track_of_the_list_can_be_asked_for(flight):
    """The list would be of no use."""
    listed = flight.tracks[0]
    header = flight.track.header
    assert header.track_id == listed.track_id
    x1, y1, x2, y2 = header.box_source_px
    assert (x2 - x1) * (y2 - y1) > 100
    assert header.codec == "h264-intra", "the video's decoder is at the ground, not with whoever asks"


def test_what_cannot_be_had_is_refused_in_a_sentence(flight):
    """The operator would wait, or see a traceback."""
    said = ["no track 99999", "is not held", "not inside the frame of 960x540", "takes at least", "M99"]
    for text, reason in zip(said, flight.refusals, strict=True):
        assert text in reason
        assert reason.startswith("uav-1 refuses: ")


def test_the_command_line_writes_the_picture(flight, long_scene):
    """An operator without Python could not ask."""
    code, told, err = flight.told
    assert code == 0, err
    assert "200x150 pixels at 300,100" in told
    index = int(told.split("frame ")[1].split(",")[0])
    assert shows(long_scene, index, cv2.imread(str(flight.folder / "a.png")))
    assert flight.nobody[0] == 2
    assert "edge 'uav-2' does not answer" in flight.nobody[2]


def test_another_budget_holds(flight):
    """What was said to the edge would have no effect."""
    assert flight.kbps == (500, 300)


def test_both_ledgers_know_what_was_asked_for(flight):
    """Stills on demand would be bits that nobody counted."""
    assert flight.edge["stills"]["reasons"]["sent"]["asked"] == 4
    assert flight.edge["worst_window_bps"]["total"] <= 500_000
    agree(flight.edge, flight.ground)


@pytest.mark.nightly
def test_video_alone_follows_objects_once_somebody_asks_for_them(tmp_path):
    """A pilot who flies video alone would never get a list of objects, or the edge would follow them for nobody."""
    with Link(tmp_path) as link:
        link.ground("--detector", "motion", "--classifier", "none")
        link.edge(
            *("--source", "demo", "--fps", "10", "--size", "640x384", "--preset", "ultrafast"),
            *("--method", "M0", "--store", "0", "--edge-id", "uav-1"),
        )
        with EdgeClient.connect(link.ground_endpoint) as edges:
            eventually(lambda: edges.names() == ["uav-1"], what="it flies")
            one, said, listed = edges["uav-1"], [], []

            def tracked() -> bool:
                time.sleep(0.1)
                try:
                    listed.extend(one.tracks())
                except RefusedError as error:
                    said.append(str(error))
                return bool(listed)

            eventually(tracked, what="objects are followed")
    assert any("request again in a second" in one for one in said)
