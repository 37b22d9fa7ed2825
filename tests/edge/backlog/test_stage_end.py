"""How the edge leaves a link and comes back to it, and how a run ends: nothing that was admitted may be lost."""

import threading

import pytest

from hvt_edge.backlog.entry import worth
from hvt_edge.link.transmitter import Chunk
from hvt_edge.stills.outbox import OutboxStill
from programs.processes import eventually
from rigs.keeping import PENDING, STILL, Rig
from rigs.kept import S, add_stills, opened


def test_what_nobody_acknowledged_is_kept_when_the_run_ends(tmp_path):
    """A link that breaks a second before the end, or before Ctrl-C, would cost the last second."""
    rig = Rig(tmp_path / "store")
    rig.play(0, 28, reports=True)
    rig.out.dark = True
    rig.play(28, 40, reports=True)
    rig.still(0, utility=2.5)
    kept = [unit.frame_index for unit in rig.kept()]
    assert kept == list(range(28, 40))
    assert rig.stored_stills() == {0: worth(2.5, STILL.header.capture_ns)}


@pytest.mark.parametrize("reports", [True, False])
def test_a_run_that_was_heard_to_its_end_or_by_nobody_keeps_nothing(tmp_path, reports):
    """Each demo would leave its last frames in somebody's home, and send them twice."""
    rig = Rig(tmp_path / "store")
    rig.play(0, 28, reports=reports)
    if reports:
        rig.still(0)
        rig.report()
    else:
        assert rig.finish(reports=False) == []
    rig.backlog.close()
    assert not (tmp_path / "store").exists()


@pytest.mark.parametrize("adapt", [False, True], ids=["budget", "adapt"])
def test_frames_and_stills_lost_at_the_end_of_a_clip_come_as_what_was_kept(tmp_path, adapt):
    """The end of a clip would be missing; with --adapt what was kept would wait for what is lost, for ever."""
    rig = Rig(tmp_path / "store", adapt=adapt)
    rig.play(0, 35, reports=True)
    rig.still(0)
    rig.report()
    rig.out.dark = True
    rig.play(35, 37)
    rig.still(1)
    rig.out.dark = False
    notes = rig.finish()
    ground = rig.out.ground
    assert set(ground.backlog_frames) == set(rig.coded) - ground.frames >= {36}
    assert ground.backlog_stills == {1}
    assert ground.frames >= set(rig.coded) - {35, 36}
    assert set(ground.twice.values()) == {1}
    assert len(notes) == 1
    rig.backlog.close()
    assert not list((tmp_path / "store").rglob("*.still"))
    assert "stored" not in rig.ledger.outcomes("sent"), "it counted when it was sent"


def test_an_outage_at_the_end_of_a_clip_is_waited_out(tmp_path):
    """What was kept last would stay on the drone until its next start."""
    rig = Rig(tmp_path / "store")
    rig.play(0, 21, reports=True)
    rig.play(21, 110, linked=False)
    rig.store()
    rig.linked = True
    rig.finish()
    ground = rig.out.ground
    assert ground.frames | set(ground.backlog_frames) == set(range(110))
    assert {number: ground.backlog_frames[number] for number in range(21, 110)}.items() <= rig.coded.items()
    assert ground.backlog_stills == {STILL.header.sequence}
    assert rig.ledger.outcomes("sent")["stored"] == 1
    assert rig.backlog.worker.numbers.empty
    assert len(rig.out.backlog) > 10
    assert rig.ledger.worst_window_bps.total <= 800_000, "the hard budget holds for this too"
    rig.backlog.close()


def test_the_end_of_a_clip_without_a_link_does_not_wait_for_ever(tmp_path):
    """A script that plays one clip after the other would hang."""
    rig = Rig(tmp_path / "store")
    rig.play(0, 21, reports=True)
    rig.play(21, 30, linked=False)
    began_ns = rig.now_ns
    rig.finish()
    assert 6 * S <= rig.now_ns - began_ns <= 8 * S
    assert [unit.frame_index for unit in rig.kept()] == list(range(21, 30)), "they stay for the next start"


def test_stills_sent_while_the_link_was_coming_back_are_kept(tmp_path):
    """They went into the dark, and nobody would know of them."""
    rig = Rig(tmp_path / "store")
    rig.play(0, 21, reports=True)
    rig.play(21, 30, linked=False)
    assert rig.backlog.offline
    rig.still(0, utility=1.5)  # the other thread had not noticed
    rig.play(30, 31, linked=True)
    assert not rig.backlog.offline
    rig.stills.store_lost(rig.now_ns)
    assert rig.stored_stills() == {0: worth(1.5, STILL.header.capture_ns)}


def test_after_frames_that_were_kept_the_link_goes_on_with_a_keyframe(tmp_path):
    """The ground would show frames that build on others that it never had."""
    rig = Rig(tmp_path / "store")
    rig.play(0, 21, reports=True)
    rig.play(21, 30, linked=False)
    rig.admits = lambda _now_ns, _line_bytes, _coding_ns: (
        len(rig.asked) % 3 == 1
    )  # the link fills between two questions
    asked = len(rig.asked)
    rig.play(30, 60, linked=True)
    assert len(rig.asked) - asked == 30, "once for each frame"
    after = [header for header in rig.out.base if header.frame_index >= 30]
    assert after[0].keyframe
    before = [header for header in rig.out.base if header.frame_index < 30]
    assert [one.sequence for one in after] == list(
        range(before[-1].sequence + 1, rig.sender.base_sequence + 1)
    )
    first = after[0].frame_index
    sent = {header.frame_index for header in rig.out.base}
    assert {unit.frame_index for unit in rig.kept()} >= set(range(21, first)), "until then all is kept"
    assert not sent & set(range(21, first))


def test_a_segment_that_begins_while_the_link_returns_does_not_put_the_picture_off(tmp_path):
    """The link would be back, and the picture not, until the next keyframe of the plan a minute later."""
    rig = Rig(tmp_path / "store")
    rig.play(0, 21, reports=True)
    rig.play(21, 169, linked=False)
    rig.admits = lambda _now_ns, _line_bytes, _coding_ns: False
    assert not rig.backlog.segment_due(rig.now_ns)
    rig.play(169, 171, linked=True)  # the link returns, and is full
    assert not rig.backlog.offline
    rig.play(171, 179, linked=True)  # ten seconds after the segment began, the next begins
    rig.admits = lambda _now_ns, _line_bytes, _coding_ns: True
    rig.play(179, 199, linked=True)
    after = [header.frame_index for header in rig.out.base if header.frame_index >= 169]
    assert after == list(range(after[0], 199))
    assert after[0] <= 189, "within the patience of a keyframe that is due"
    keyframes = [unit.frame_index for unit in rig.kept() if unit.keyframe and unit.frame_index < 179]
    assert keyframes == [21, 171], "a segment began while the link returned"


def test_only_to_who_reports_is_anything_sent_that_was_kept(tmp_path):
    """Whoever listens and never answers would get it all, and a ground would then find the store empty."""
    with opened(tmp_path / "store", session_id=6) as folder:
        add_stills(folder, {1: 1.0})
    rig = Rig(tmp_path / "store")
    rig.play(0, 60)
    assert not rig.backlog.chunk_allowance(rig.now_ns)
    rig.report()
    assert rig.backlog.chunk_allowance(rig.now_ns)
    assert not rig.backlog.chunk_allowance(rig.now_ns + 2 * S), "it has fallen silent"
    rig.backlog.close()


def _fill(rig: Rig, *, first: int) -> int:
    # Live stills go out, by number, until there is no room for a whole chunk.
    while rig.backlog.chunk_allowance(rig.now_ns) not in (0, 1400):
        rig.still(first)
        first += 1
    return first


def test_what_may_be_sent_now_and_how_much(tmp_path, monkeypatch):
    """Backfill would go before the picture, or before a live still."""
    rig = Rig(tmp_path / "store")
    rig.play(0, 21, reports=True)
    assert not rig.backlog.chunk_allowance(rig.now_ns), "the link is two seconds old at the least"
    rig.play(21, 60, reports=True)
    assert rig.backlog.chunk_allowance(rig.now_ns)
    rig.keyframes.request(rig.now_ns)
    assert not rig.backlog.chunk_allowance(rig.now_ns), "a keyframe is to come"
    rig.play(60, 75, reports=True)
    assert rig.backlog.chunk_allowance(rig.now_ns)
    pending = OutboxStill(PENDING, None, 1.0, rig.now_ns)
    assert rig.backlog.chunk_allowance(rig.now_ns) == 5000, "50 ms of 800 kbps"
    rig.outbox.offer(pending)
    sent = _fill(rig, first=0)
    rig.outbox.give_up(pending)
    assert rig.backlog.chunk_allowance(rig.now_ns) != 1400, "all that stills have is kept for the pending one"
    _fill(rig, first=sent)
    assert rig.backlog.chunk_allowance(rig.now_ns) == 1400, (
        "a third of the stills' share stays free, but for the backlog's own"
    )
    rig.play(75, 90, linked=False)
    assert not rig.backlog.chunk_allowance(rig.now_ns)
    monkeypatch.setattr(
        rig.sender, "backlog_allowance_bytes", lambda _now_ns, *, reserve: 999 + (reserve != 0)
    )
    rig.play(90, 140, linked=True, reports=True)
    assert rig.backlog.chunk_allowance(rig.now_ns) == 1_000, "of a small budget that is a whole one"
    (ended := threading.Event()).set()
    rig.backlog.finish(before_frame=lambda _now_ns: None, stop=ended, note=str)
    rig.outbox.offer(pending)
    rig.keyframes.require(rig.now_ns)
    assert rig.backlog.chunk_allowance(rig.now_ns) == 999, "no still or keyframe comes after the last frame"
    rig.backlog.close()


def test_where_live_stills_always_wait_a_trickle_goes_on(tmp_path):
    """A busy scene would keep what was admitted before from ever arriving; or be held up by it."""
    rig = Rig(tmp_path / "store")
    rig.play(0, 60, reports=True)
    rig.outbox.offer(OutboxStill(PENDING, None, 1.0, rig.now_ns))
    _fill(rig, first=0)
    sent_ns = []
    for _ in range(60):
        rig.now_ns += S // 20
        rig.report()
        _fill(rig, first=rig.sender.still_sequence + 1)
        if limit_bytes := rig.backlog.chunk_allowance(rig.now_ns):
            assert rig.backlog.send_chunk(Chunk((7, "still", 0), 0, 10_000, bytes(limit_bytes)))
            sent_ns.append(rig.now_ns)
    assert 4 <= len(sent_ns) <= 6, "1400 bytes and their headers in .6 s, a fortieth of 800 kbps"
    rig.backlog.close()


def test_kept_video_leaves_the_stills_its_share_and_no_more(tmp_path):
    """With --borrow-unused the stills of an outage would take all that the video had, and leave none to it."""
    rig = Rig(tmp_path / "store", borrow_unused=True, budget=(400_000, 300_000))
    rig.play(0, 15, reports=True)
    stills = 0
    for first in range(15, 150):
        rig.play(first, first + 1, linked=False)
        room = rig.sender.still_allowance_bytes(rig.now_ns, paced=False)
        while room >= 1500:
            rig.store()
            stills += 1
            room = rig.sender.still_allowance_bytes(rig.now_ns, paced=False)
    video = sum(len(rig.coded[index]) for index in range(15, 150))
    carry = 2.0 * 100_000 / 8
    assert stills * 1500 + video <= 9 * 400_000 / 8 + carry
    assert stills * 1500 >= 9 * 100_000 / 8, "their own share they have"
    rig.backlog.close()


def test_in_an_outage_stills_have_the_room_that_the_link_gave_them(tmp_path):
    """The pacer takes silence for a link of 100 kbps: not one still of the outage would be kept."""
    rig = Rig(tmp_path / "store", adapt=True)
    rig.play(0, 21, reports=True)
    assert rig.sender.budget.total_bps == 800_000
    rig.out.dark = True
    rig.play(21, 60)
    assert rig.backlog.offline
    assert rig.pacer.rate_bps == 100_000
    assert rig.sender.budget.total_bps == 800_000
    assert rig.sender.still_allowance_bytes(rig.now_ns, paced=False) > 5_000
    rig.out.dark = False
    rig.report()
    rig.play(60, 62)
    assert not rig.backlog.offline
    assert rig.sender.budget.total_bps == rig.pacer.rate_bps < 800_000, "first the link shows what it carries"
    rig.backlog.close()


def test_an_error_in_the_stores_thread_ends_storing_alone(tmp_path):
    """A bug in what is for later would end the video of now."""

    def broken() -> bytes:
        raise ZeroDivisionError

    rig = Rig(tmp_path / "store", info=broken)
    rig.play(0, 7, reports=True)
    rig.store()
    eventually(lambda: rig.backlog.worker.failed, what="it is noticed")
    rig.play(7, 12, reports=True)
    rig.backlog.close()


def test_stills_of_a_former_run_count_for_that_one(tmp_path):
    """The summary would have more stills sent than were ever chosen."""
    with opened(tmp_path / "store", session_id=6) as folder:
        add_stills(folder, {2**31 + 5: 1.0, 3: 1.0})
    rig = Rig(tmp_path / "store")
    rig.play(0, 21, reports=True)
    rig.finish()
    assert len([key for key in rig.out.ground.twice if key[1] == "still"]) == 2
    assert rig.backlog.worker.numbers.sent_stills == 2
    assert "stored" not in rig.ledger.outcomes("sent")
    rig.backlog.close()
