"""A picture of the finished screen, taken without a screen."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from rerun.experimental import ViewerClient

from hvt_archive.joined import join_recordings
from hvt_archive.screenshot import main, screenshot
from hvt_common.errors import UserError
from hvt_ground.events import Notice
from media.recorded_feed import coded, drawn_frames, session
from programs import rrd
from programs.rrd import Recording

needs_viewer = pytest.mark.skipif(
    shutil.which("ffmpeg") is None or not list(Path("/usr/share/vulkan/icd.d").glob("*.json")),
    reason="the headless viewer needs ffmpeg and a Vulkan driver (Debian: ffmpeg, mesa-vulkan-drivers)",
)


@needs_viewer
def test_the_screen_shows_video_gallery_and_boxes(tmp_path: Path, monkeypatch) -> None:
    """A recording that opens as an error message or an empty grid is not finished; a busy machine draws late."""
    late, take = (
        [TimeoutError("Deadline expired before operation could complete")],
        ViewerClient.take_screenshot,
    )

    def taken(client: ViewerClient) -> bytes:
        if late:
            raise late.pop()
        return take(client)

    monkeypatch.setattr(ViewerClient, "take_screenshot", taken)
    frames = drawn_frames(30, (640, 384))
    path, out = tmp_path / "a.rrd", tmp_path / "a.png"
    feed = session(frames, coded(frames, kbps=400), tracks=6, total_kbps=900)
    rrd.recorded(path, (event for event, _ in feed), base_size=(640, 384), budget_bps=600_000.0)
    assert main([str(path), "--frame", "25", "--out", str(out), "--size", "1280x800"]) == 0
    picture = cv2.imread(str(out))
    assert picture.shape[1] == 1280
    assert 700 < picture.shape[0] < 800
    video = picture[60:500, 30:760]
    # The ground of the scene is grey noise of middle brightness; the viewer's own background is nearly black.
    assert np.median(video) > 60
    gallery = picture[40:420, 830:1260]
    assert (gallery.max(axis=2) > 60).mean() > 0.15
    box_blue = np.array([233, 180, 86])  # BGR of the class "car"
    assert (np.abs(picture.astype(int) - box_blue).max(axis=2) < 12).sum() > 200


def test_a_missing_recording_is_one_sentence(tmp_path: Path) -> None:
    """A mistyped path must not start a viewer and wait."""
    with pytest.raises(UserError, match="does not exist"):
        screenshot(tmp_path / "none.rrd", frame=0, out=tmp_path / "a.png")
    (tmp_path / "a.rrd").touch()
    with pytest.raises(UserError, match=r"--out .*gone.* is in a folder that does not exist"):
        screenshot(tmp_path / "a.rrd", frame=0, out=tmp_path / "gone" / "a.png")


@needs_viewer
def test_a_name_that_the_viewer_cannot_draw_is_one_sentence(tmp_path: Path) -> None:
    """A class with an emoji ended in a traceback."""
    text = Notice(0, 0, "info", "a \U0001f697 was seen")
    path = rrd.recorded(tmp_path / "a.rrd", [text], edge_id="uav-1", base_size=(64, 48))
    with pytest.raises(UserError, match=r"the viewer ended while it drew .*a\.rrd"):
        screenshot(path, frame=0, out=tmp_path / "a.png")


# Several recordings as one.


def recorded(path, edge):
    notice = Notice(3, 200_000_000, "info", f"here is {edge}")
    return rrd.recorded(path, [notice], edge_id=edge, session="01", base_size=(64, 48))


def test_each_edge_keeps_what_is_its_own(tmp_path):
    """One flight's boxes would lie on another one's picture."""
    paths = [recorded(tmp_path / f"{edge}.rrd", edge) for edge in ("a", "b")]
    join_recordings(paths, tmp_path / "all.rrd", base_size=(64, 48), fps=15)
    both = Recording(tmp_path / "all.rrd")
    assert both.blueprints == 1
    for edge in ("a", "b"):
        assert [value for _, _, value in both.rows(f"/{edge}/events", "TextLog:text")] == [
            [f"here is {edge}"]
        ]


def test_what_cannot_be_joined_is_said(tmp_path):
    """One flight would hide the other, or a traceback be all there is."""
    one, text = recorded(tmp_path / "a.rrd", "a"), tmp_path / "text.rrd"
    text.write_text("no recording")
    for paths, out, said in (
        ([one, one], "all.rrd", "same edge"),
        ([one], "gone/all.rrd", r"--out .*gone.* is in a folder that does not exist"),
        ([one, text], "all.rrd", r"text\.rrd"),
    ):
        with pytest.raises(UserError, match=said):
            join_recordings(paths, tmp_path / out, base_size=(64, 48), fps=15)
