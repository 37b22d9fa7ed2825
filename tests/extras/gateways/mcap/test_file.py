"""The MCAP file of a ground that never came to close it."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.reader import NonSeekingReader

from hvt_common.errors import UserError
from hvt_gateways.mcap.file import McapFile
from hvt_ground.events import Notice
from programs.small_disk import files_at_most


def test_a_ground_that_was_killed_leaves_all_but_the_last_moment(tmp_path: Path) -> None:
    """On a link of 40 kbps a minute of the flight would be missing, or the file be empty."""
    path = tmp_path / "flight.mcap"
    file = McapFile(path, edge="uav-1")
    for index in range(200):
        file.log(Notice(index, index, "info", f"{index} " + "x" * 1000))
    found = 0
    with path.open("rb") as killed:  # as it is now: nobody closes it
        try:
            for _ in NonSeekingReader(killed).iter_messages(log_time_order=False):
                found += 1
        except Exception:  # noqa: BLE001 - it breaks off
            pass
    assert 200 - found <= 32
    file.close()


def test_a_full_disk_is_a_sentence_and_leaves_no_empty_file(tmp_path: Path) -> None:
    """Each try for an hour left one, and said that MCAP works again; at the end an operator read an error number."""
    ended = McapFile(tmp_path / "ended.mcap", edge="uav-1")
    with files_at_most(0):
        with pytest.raises(UserError, match=r"MCAP file .*new\.mcap cannot be created: File too large"):
            McapFile(tmp_path / "new.mcap", edge="uav-1")
        with pytest.raises(UserError, match=r"MCAP file .*ended\.mcap cannot be finished: File too large"):
            ended.close()
    assert [one.name for one in tmp_path.iterdir()] == ["ended.mcap"]
