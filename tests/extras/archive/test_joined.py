"""Several recordings as one."""

from __future__ import annotations

import pytest

from hvt_archive.joined import join_recordings
from hvt_common.errors import UserError
from hvt_ground.events import Notice
from hvt_ground.sinks.rerun.recorder import Recorder, RecorderSettings
from programs.rrd import Recording


def recorded(path, edge):
    settings = RecorderSettings(
        path=path, edge_id=edge, session="01", base_size=(64, 48), fps=15, budget_bps=1e5
    )
    with Recorder(settings) as recorder:
        recorder.log(Notice(3, 200_000_000, "info", f"here is {edge}"))
    return path


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
    one = recorded(tmp_path / "a.rrd", "a")
    with pytest.raises(UserError, match="same edge"):
        join_recordings([one, one], tmp_path / "all.rrd", base_size=(64, 48), fps=15)
    (tmp_path / "text.rrd").write_text("no recording")
    with pytest.raises(UserError, match=r"--out .*gone.* is in a folder that does not exist"):
        join_recordings([one], tmp_path / "gone" / "all.rrd", base_size=(64, 48), fps=15)
    with pytest.raises(UserError, match=r"text\.rrd"):
        join_recordings([one, tmp_path / "text.rrd"], tmp_path / "all.rrd", base_size=(64, 48), fps=15)
