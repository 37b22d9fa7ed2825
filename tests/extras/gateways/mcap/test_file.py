"""The MCAP file of a ground that never came to close it."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.reader import NonSeekingReader

from hvt_common.errors import UserError
from hvt_gateways.mcap.file import McapFile
from hvt_ground.events import Notice


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


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_a_full_disk_at_its_end_is_a_sentence() -> None:
    """The last chunk is in a buffer until then: an operator would read an error number."""
    with pytest.raises(UserError, match="MCAP file /dev/full cannot be finished: No space left on device"):
        McapFile(Path("/dev/full"), edge="uav-1").close()
