"""Between the link and the store: real frames, a real encoder, a real folder, a link that goes and comes."""

import logging
from pathlib import Path

import pytest

from hvt_common.protocol.channels import Channel
from hvt_common.protocol.messages import Flags, RoiHeader, parse_backlog_still
from hvt_common.values import AccessUnit
from hvt_common.video.hevc import BaseDecoder
from hvt_edge.backlog.worker import IntakeStill, StoreWorker
from hvt_edge.config import EdgeConfig, check
from hvt_edge.wiring.link import channels_of
from programs.processes import eventually
from rigs.keeping import STILL, Rig
from rigs.kept import opened


def test_what_is_coded_in_an_outage_is_kept_and_all_else_is_sent(tmp_path):
    """Frames would be missing, or be sent to nobody and count as sent."""
    rig = Rig(tmp_path / "store")
    rig.play(0, 30, linked=True)
    rig.play(30, 60, linked=False)
    rig.play(60, 90, linked=True)
    sent = [header.frame_index for header in rig.out.base]
    assert sent == [*range(30), *range(60, 90)]
    assert [header.sequence for header in rig.out.base] == list(range(60)), "no hole for what was kept"
    assert rig.backlog.frames == 30
    assert [header.frame_index for header in rig.out.base if header.keyframe] == [0, 60]
    kept = rig.kept()
    # No report ever came: what was sent shortly before is kept too.
    assert [unit.frame_index for unit in kept] == list(range(60))
    assert {unit.frame_index: unit.data for unit in kept}.items() <= rig.coded.items()
    first_kept = next(unit for unit in kept if unit.frame_index == 30)
    assert first_kept.keyframe, "the stretch of the outage can be shown by itself"
    decoder = BaseDecoder()
    shown = [decoder.decode(data) for row, data, _ in rig.out.puts if row is Channel.BASE]
    assert all(picture is not None for picture in shown), "nothing builds on frames that the ground never had"


def test_what_was_in_flight_is_kept_without_a_hole(tmp_path, monkeypatch):
    """A slow disk would take the frames behind one that it refused, and the ground show garbage."""
    rig, offered, offer = Rig(tmp_path / "store"), [], StoreWorker.offer

    def slow(worker: StoreWorker, item: AccessUnit | IntakeStill) -> bool:
        offered.append(item)
        return len(offered) != 11 and offer(worker, item)

    monkeypatch.setattr(StoreWorker, "offer", slow)
    rig.play(0, 20, linked=True)
    rig.play(20, 30, linked=False)
    assert [unit.frame_index for unit in rig.kept()] == [*range(10), *range(20, 30)]


def test_a_silent_ground_is_asked_with_a_frame_a_second_that_nobody_shows(tmp_path):
    """Nobody would notice that the link is back; or the ground would show garbage."""
    rig = Rig(tmp_path / "store")
    rig.play(0, 15, linked=True)
    rig.backlog.on_feedback(rig.out.ground.report(rig.now_ns), now_ns=rig.now_ns)
    rig.play(15, 120, linked=True)
    headers = rig.out.base
    offline = next(
        n for n, one in enumerate(headers[:-1]) if headers[n + 1].frame_index > one.frame_index + 1
    )
    probes = headers[offline + 1 :]
    assert 15 + 22 <= headers[offline].frame_index <= 15 + 23, "a second and a half"
    assert 4 <= len(probes) <= 6
    before = headers[offline].sequence
    for probe in probes:
        assert probe.keyframe or probe.sequence == before + 2, "a number is left out"
        before = probe.sequence
    rig.backlog.on_feedback(rig.out.ground.report(rig.now_ns), now_ns=rig.now_ns)
    rig.play(120, 135, linked=True)
    assert [one.frame_index for one in rig.out.base[-15:]] == list(range(120, 135))
    assert rig.out.base[-15].keyframe
    kept = [unit.frame_index for unit in rig.kept()]
    assert kept == sorted(set(kept)), "nothing twice"
    # The newest are not acknowledged at the end of the run: they are kept too.
    assert set(kept) | {one.frame_index for one in headers} == set(range(135))


def test_a_camera_without_a_ground_is_kept_from_the_first_frame_and_sent_when_requested(tmp_path):
    """The flight before the ground was switched on; who asks an empty store would wait for ever."""
    rig = Rig(tmp_path / "store", live=True)
    assert not rig.backlog.send_video()
    rig.play(0, 30, linked=False)
    assert rig.out.base == []
    eventually(lambda: rig.backlog.worker.numbers.video_s > 1.9, what="the frames are on disk")
    assert rig.backlog.send_video()
    assert [unit.frame_index for unit in rig.kept()] == list(range(30))


def test_a_kept_still_is_as_it_would_have_come_and_takes_its_budget(tmp_path):
    """The ground could not place it; or an outage would be free of all limits."""
    rig = Rig(tmp_path / "store")
    rig.play(0, 5, linked=True)
    rig.play(5, 8, linked=False)
    for _ in range(40):
        rig.store(utility=1.5)
    assert rig.sender.still_allowance_bytes(rig.now_ns, paced=False) <= 100_000 - 40 * 1500
    rig.backlog.close()
    with opened(tmp_path / "store", session_id=8) as folder:
        (kept,) = (parse_backlog_still(folder.read(entry)) for entry in folder.best_stills())
    header = RoiHeader.parse(kept.attachment, kept.payload)
    assert (kept.payload, kept.encoding) == (STILL.data, "image/jpeg")
    assert (header.sequence, header.session_id, header.flags & Flags.STORED) == (2**31, 7, Flags.STORED)
    assert not [row for row, _, _ in rig.out.puts if row is Channel.ROI]


def test_a_store_that_cannot_be_written_costs_a_warning_and_no_frame(tmp_path, caplog):
    """The flight would end for a full disk."""
    (tmp_path / "file").write_text("in the way")
    rig = Rig(tmp_path / "file" / "store")
    with caplog.at_level(logging.WARNING):
        rig.play(0, 15, linked=True)
        rig.play(15, 25, linked=False)
        eventually(lambda: rig.backlog.worker.failed, what="the disk has said no")
        rig.play(25, 60, linked=False)
        rig.play(60, 80, linked=True)
        rig.play(80, 90, linked=False)
        (tmp_path / "file").unlink()
        rig.play(90, 150, linked=False)
        eventually(lambda: not rig.backlog.worker.failed, what="it is tried again")
        rig.play(150, 170, linked=False)
    rig.backlog.close()
    (failed, _works) = caplog.messages
    assert "--store-folder" in failed
    again = rig.out.base[15:]
    first = again[0].frame_index
    assert 16 <= first <= 25
    assert again[0].keyframe
    sent = [one.frame_index for one in again]
    assert sent == list(range(first, first + len(sent))), "from then on as without a store"
    assert 90 <= sent[-1] < 150
    (part,) = rig.failures.parts
    assert (part.part, part.working) == ("store", True)
    with opened(tmp_path / "file" / "store", session_id=8) as store:
        assert store.segments, "stored again"


@pytest.mark.parametrize(
    ("settings", "live", "stored"),
    [
        ({}, True, True),
        ({}, False, False),
        ({"store": 10**7}, False, True),
        ({"store_folder": Path("store")}, False, True),
        ({"store_folder": Path("store"), "store": 0}, True, False),
        ({"store_folder": Path("store"), "pace": "lockstep"}, True, False),
    ],
)
def test_only_live_sources_are_stored_unless_requested(settings, live, stored):
    """The next run, of another clip, would send what was left of this one; or the same input give other bytes."""
    config = check(EdgeConfig(source="demo", **settings))
    assert bool(config.store_bytes(live=live)) == stored
    assert (Channel.BACKLOG in channels_of(config, live=live)) == stored, "grounds are told"
