"""The MCAP file of a ground that never came to close it."""

from collections import Counter
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import NonSeekingReader, make_reader

from hvt_common.errors import UserError
from hvt_gateways.mcap.file import McapFile
from hvt_ground.events import Notice
from programs.small_disk import files_at_most
from rigs import examples


def test_a_ground_that_was_killed_leaves_all_but_the_last_moment(tmp_path: Path) -> None:
    """On a link of 40 kbps a minute of the flight would be missing, or the file be empty."""
    file = McapFile(tmp_path / "flight.mcap", edge="uav-1")
    for index in range(200):
        file.log(Notice(index, index, "info", f"{index} " + "x" * 1000))
    found = 0
    with file.path.open("rb") as killed, suppress(Exception):  # as it is now: nobody closes it, it breaks off
        for _ in NonSeekingReader(killed).iter_messages(log_time_order=False):
            found += 1
    assert 200 - found <= 32
    file.close()


def test_a_still_of_several_objects_is_one_picture(tmp_path: Path) -> None:
    """Half of the file were pictures that are in it already, and a count of the stills too large."""
    path = tmp_path / "flight.mcap"
    jpeg = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    file = McapFile(path, edge="uav-1")
    for still, track in ((1, 5), (1, 6), (2, 5)):
        file.log(examples.refinement(still_sequence=still, track_id=track, still=jpeg))
    file.close()
    with path.open("rb") as written:
        topics = Counter(channel.topic for _, channel, _ in make_reader(written).iter_messages())
    assert topics == {"/uav-1/stills": 2, "/uav-1/events": 3}


def test_a_full_disk_is_a_sentence_and_leaves_no_empty_file(tmp_path: Path) -> None:
    """Each try for an hour left one, and said that MCAP works again; at the end an operator read an error number."""
    ended = McapFile(tmp_path / "ended.mcap", edge="uav-1")
    with files_at_most(0):
        with pytest.raises(UserError, match=r"MCAP file .*new\.mcap cannot be created: File too large"):
            McapFile(tmp_path / "new.mcap", edge="uav-1")
        with pytest.raises(UserError, match=r"MCAP file .*ended\.mcap cannot be finished: File too large"):
            ended.close()
    assert [one.name for one in tmp_path.iterdir()] == ["ended.mcap"]
