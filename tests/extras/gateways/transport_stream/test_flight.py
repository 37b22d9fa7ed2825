"""A flight of the drawn scene with ``--ts``: all that other sinks have is in the stream."""

from collections import defaultdict

import pytest

import hvt_ground.cli
from hvt_archive.reading.recorded import read_recordings
from hvt_common.video.hevc import nal_units
from media.klv_reader import read_stream
from rigs.drawn_flight import FRAMES, VIEW

pytestmark = pytest.mark.integration


def units(data: bytes) -> list[bytes]:
    """All but the access unit delimiter."""
    return [one for one in nal_units(data) if one[0] >> 1 != 35]


def test_video_tracks_and_places_are_those_of_the_other_sinks(drawn):
    """An operator with another program would see another flight."""
    found = read_stream(drawn.folder / "flight.ts")
    recorded = read_recordings([drawn.folder / "flight.rrd"])
    assert [units(data) for _, data in found.video] == [units(one.data) for one in recorded.video]
    assert len(found.video) == FRAMES
    rows = defaultdict(dict)
    for row in drawn.tracks():
        if row["doubted"] == "0":
            rows[int(row["frame_index"])][int(row["id"])] = row
    words = {
        (one.frame_index, track_id): word
        for one in recorded.overlays()
        for track_id, word in zip(one.track_ids.tolist(), one.words, strict=True)
    }
    assert len(found.klv) >= FRAMES
    placed, wide = 0, VIEW.base_size[0]
    for packet in found.klv:
        assert packet.vmti is not None
        frame = int.from_bytes(packet.vmti[7])
        mine = rows.pop(frame, {})
        assert {one.track_id for one in packet.targets} == set(mine)
        for target in packet.targets:
            row = mine[target.track_id]
            assert target.class_name == words[frame, target.track_id]
            assert target.number(5) == pytest.approx(100 * float(row["confidence"]), abs=0.6)
            x, y = target.number(2) % wide - 1, target.number(2) // wide
            assert (x, y) == pytest.approx((float(row["x"]), float(row["y"])), abs=1.1)
            if row["latitude"]:
                offset = int.from_bytes(target.items[10]) * 2.0**-17 - 19.2
                assert packet.items[23] + offset == pytest.approx(float(row["latitude"]), abs=1e-5)
                placed += 1
    assert not rows, "every frame with tracks is in the stream"
    assert placed > 1_000


def test_an_export_of_the_recording_says_the_same(drawn, tmp_path):
    """Who asks for it afterwards would have less."""
    out = tmp_path / "again.ts"
    assert hvt_ground.cli.main(["export", str(drawn.folder / "flight.rrd"), "--out", str(out)]) == 0
    live, again = read_stream(drawn.folder / "flight.ts"), read_stream(out)
    assert again.video == live.video
    assert len(again.klv) == len(live.klv)
    for mine, other in zip(live.klv, again.klv, strict=True):
        assert mine.items.keys() == other.items.keys()
        assert mine.items[13] == pytest.approx(other.items[13], abs=2e-5)
        assert mine.items[23] == pytest.approx(other.items[23], abs=2e-5)
        assert [one.track_id for one in mine.targets] == [one.track_id for one in other.targets]
        assert [one.class_name for one in mine.targets] == [one.class_name for one in other.targets]
