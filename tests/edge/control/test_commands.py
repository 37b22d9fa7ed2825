"""What an edge does when it is asked for more, with its real parts and a real budget."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_common.protocol.messages import Command, ControlRequest, RoiHeader
from hvt_common.video.still_codecs import still_codec
from hvt_edge.link.budget import BudgetSettings, RollingBudget
from media.clips import START_NS
from rigs.command_rig import FRAME_NS, SESSION, VIEW, Rig, picture


def shown(header: RoiHeader, data: bytes) -> np.ndarray:
    x1, y1, x2, y2 = header.crop_source_px
    size = header.parameters.get("w", x2 - x1), header.parameters.get("h", y2 - y1)
    return still_codec(header.codec).decode(data, size=size, parameters=header.parameters)


def test_a_box_of_three_seconds_ago_is_cut_from_the_frame_of_then():
    """The operator would look closer at a place that the object has left long ago."""
    rig = Rig()
    rig.run(60)
    answer = rig.ask("still", x=300, y=200, w=96, h=64, at_ms=-3000, quality=90)
    assert (answer.accepted, answer.reason, answer.frame_index) == (True, "", 14)
    rig.run(3)
    ((header, data),) = rig.asked()
    assert header.parameters == {"ask": answer.still_request}
    assert (header.frame_index, header.crop_source_px, header.track_id) == (14, (300, 200, 396, 264), -1)
    truth = picture(14)[200:264, 300:396]
    assert cv2.PSNR(shown(header, data), truth) > 25, "its noise is coloured, and colour is kept at half size"
    other = picture(59)[200:264, 300:396]
    assert cv2.PSNR(shown(header, data), other) < 20


def source_box(rig: Rig, frame_index: int):
    """Where the car is at that frame, in source pixels."""
    return pytest.approx(VIEW.to_source(np.array([rig.box(frame_index)], np.float32))[0].tolist(), abs=0.1)


def test_a_track_is_found_where_it_was_at_that_frame():
    """A still of track 5 would show the road that it left."""
    rig = Rig()
    rig.run(60)
    answer = rig.ask("still", track=5, frame=20)
    rig.run(2)
    ((header, _),) = rig.asked()
    assert answer.frame_index == header.frame_index == 20
    assert (header.box_source_px, header.track_id, header.class_name) == (source_box(rig, 20), 5, "car")


def test_what_is_asked_for_goes_before_the_methods_own():
    """An operator would wait behind what a policy finds interesting."""
    rig = Rig()
    rig.run(40, others=True)
    assert rig.out.stills, "the method does send stills"
    before = len(rig.out.stills)
    answer = rig.ask("still", x=0, y=0, w=300, h=300, quality=80)
    assert answer.accepted
    rig.run(75, others=True)
    assert [header.reason for header, _ in rig.out.stills[before : before + 1]] == ["asked"]
    assert len(rig.out.stills) > before + 1, "and the others go on afterwards"
    assert rig.ledger.outcomes("sent")["asked"] == 1


@pytest.mark.parametrize("codec", ["jpeg", "residual"])
def test_no_window_exceeds_the_budget_for_it(codec):
    """A request from afar would buy one picture with the video of everybody."""
    rig = Rig("200kbps", share=0.8, codec=codec)
    for _ in range(12):
        rig.run(10, others=True)
        rig.ask("still", quality=95)
    assert rig.ledger.worst_window_bps.total <= 200_000
    assert len(rig.asked()) >= 3
    assert {header.codec for header, _ in rig.asked()} == {"jpeg"}, "who asks has no base to build on"


def test_one_that_never_fits_comes_smaller_within_some_seconds():
    """Asking for the whole frame on a thin link would never be answered, or block all other stills."""
    rig = Rig("150kbps", share=0.9)
    rig.run(40)
    answer = rig.ask("still", quality=95)
    rig.run(75)
    ((header, data),) = rig.asked()
    assert header.parameters["ask"] == answer.still_request
    assert len(data) <= 0.8 * 150_000 / 8
    assert shown(header, data).shape[1] == header.parameters["w"] < 512


REFUSED = [
    ({"quality": 10.0}, "quality is a whole number from 5 to 95, not 10.0"),
    ({"track": 9}, "no track 9 at frame 59: the edge's own tracks there are 5"),
    ({"track": 5, "at_ms": -9000}, "of 9 s ago is not held: frames go back 2.9 s"),
    ({"frame": 1000}, "frame 1000 is yet to come: the newest is 59"),
    ({"x": 900, "y": 0, "w": 100, "h": 10}, "not inside the frame of 960x540 source pixels"),
    ({"x": -1, "y": 0, "w": 100, "h": 10}, "not inside the frame"),
    ({"x": 1, "y": 1, "w": 4, "h": 400}, "too small: 8 pixels a side"),
    ({"x": 1, "y": 1, "w": 40}, "x, y, w and h, all four"),
    ({"track": 5, "x": 1, "y": 1, "w": 40, "h": 40}, "of a track or of a box"),
    ({"frame": 5, "at_ms": -5}, "of a frame or of a time"),
    ({"at_ms": 5}, "at_ms is a whole number from -3600000 to 0"),
    ({"quality": 100}, "quality is a whole number from 5 to 95"),
    ({"track": "five"}, "track is a whole number"),
    ({"zoom": 3}, "still takes no 'zoom'"),
]


def test_what_cannot_be_served_is_refused_with_the_reason():
    """The operator would wait for a picture that never comes."""
    rig = Rig(ring_s=3.0)
    rig.run(60)
    for arguments, reason in REFUSED:
        answer = rig.ask("still", **arguments)
        assert not answer.accepted
        assert reason in answer.reason
    rig.run(3)
    assert rig.asked() == []


def test_too_many_are_refused():
    """A loop at a ground would fill the drone's memory."""
    rig = Rig("150kbps", share=0.9)
    rig.run(30)
    answers = [rig.ask("still", quality=90 + number) for number in range(6)]
    assert [one.accepted for one in answers] == [True] * 4 + [False] * 2
    assert "4 requested stills are pending already" in answers[-1].reason


def test_a_request_whose_answer_was_lost_is_the_same_still():
    """Over UDP each lost answer would cost the link a second still, and the video its frames."""
    rig = Rig("150kbps", share=0.9)
    rig.run(30)
    first = rig.ask("still", track=5)
    assert rig.ask("still", track=5) == first
    assert rig.ask("still", track=5, quality=70).still_request == first.still_request + 1
    rig.run(150)
    assert len(rig.asked()) == 2
    assert rig.ask("still", track=5).still_request == first.still_request + 2, "another look"


def test_a_repeated_question_is_obeyed_once_also_when_its_still_has_gone_out():
    """The repetition of a question whose answer was lost cost a second still; a budget that was set was refused."""
    rig = Rig("150kbps", share=0.9)
    rig.run(30)
    still = ControlRequest(session_id=0, command="still", arguments={"track": 5}, request_id=7)
    first = rig.commands.answer(still)
    rig.run(150)
    assert (rig.commands.answer(still), len(rig.asked())) == (first, 1)
    budget = ControlRequest(session_id=0, command="set-budget", arguments={"bps": 120_000}, request_id=8)
    assert all(rig.commands.answer(budget).accepted for _ in range(2))
    assert rig.commands.answer(replace(still, request_id=9)).still_request == first.still_request + 1


def test_the_same_request_while_its_still_goes_out_is_answered():
    """The thread of stills takes the crop away between two looks at it, and the answer would be an error."""
    rig = Rig("150kbps", share=0.9)
    rig.run(30)
    first = rig.ask("still", track=5)
    pending = rig.outbox.on_demand
    header = pending.crop.header

    class Going:
        frame_index = header.frame_index

        @property
        def capture_ns(self) -> int:
            pending.job = None
            return header.capture_ns

    pending.job = SimpleNamespace(header=Going())
    assert rig.ask("still", track=5) == first


def test_whoever_waits_can_ask_what_became_of_it():
    """A still that was given up would be waited for until the timeout, and nobody would know why."""
    rig = Rig("150kbps", share=0.9)
    rig.run(30)
    first, second = rig.ask("still", track=5), rig.ask("still")
    rig.run(4)
    assert rig.ask("still-outcome", ask=first.still_request).accepted, "sent or waiting"
    rig.chooser.close()
    assert len(rig.asked()) in (1, 2)
    if len(rig.asked()) == 1:
        assert "the edge has ended" in rig.ask("still-outcome", ask=second.still_request).reason
    assert "nothing is known" in rig.ask("still-outcome", ask=99).reason
    assert "the edge has ended" in rig.ask("still").reason


def test_the_tracks_are_those_of_the_newest_frame_and_those_left_out_are_said(monkeypatch):
    """Ids to ask by would be guesswork; 64 of 119 came without a word: whoever counts them would count wrong."""
    rig = Rig()
    assert "no frame was looked at yet" in rig.ask("tracks").reason
    rig.run(10)
    answer = rig.ask("tracks")
    (track,) = answer.tracks
    assert (answer.frame_index, track.track_id, track.class_id, track.confidence) == (9, 5, 0, 0.8)
    assert (track.box_source_px, answer.note) == (source_box(rig, 9), "")
    frame_index, tracks, _ = rig.on_demand.tracks()
    monkeypatch.setattr(rig.on_demand, "tracks", lambda: (frame_index, tracks, 119))
    assert rig.ask("tracks").note == "of 119 tracks these are the 1 of most confidence"


def test_another_budget_counts_from_a_keyframe_that_comes_at_once():
    """An operator whose link got thin could not say so, or would wait ten seconds for it."""
    rig = Rig("800kbps")
    rig.run(20)
    rig.keyframes.done(rig.now_ns)  # so fresh that a request for a picture would be answered by it
    assert rig.ask("set-budget", bps=500_000).accepted
    assert rig.keyframes.due(rig.now_ns)
    encoder = rig.reconfiguration(1, rig.now_ns)
    assert encoder is not None
    assert rig.operating.now.base_bps == 375_000
    assert rig.budget.base_step_bytes == 375_000 / 8 / 15
    assert rig.operating.now.budget_bps == 500_000
    assert rig.reconfiguration(1, rig.now_ns) is None, "once"


def test_a_budget_that_x265_cannot_follow_is_refused_and_changes_nothing():
    """The video would overshoot a budget that somebody believes in."""
    rig = Rig("800kbps")
    for arguments, reason in (
        ({"bps": 20_000}, "20 kbps is too little for 640x360 at 15 fps: it takes at least 61 kbps"),
        ({"bps": 0}, "set-budget: bps is a whole number from 1 to 1000000000, not 0"),
        ({"bps": 10**12}, "set-budget: bps is a whole number from 1 to 1000000000, not 1000000000000"),
        ({}, "set-budget: bps is missing"),
    ):
        assert rig.ask("set-budget", **arguments).reason == reason
    assert rig.operating.now.budget_bps == 800_000
    assert rig.reconfiguration(1, rig.now_ns) is None
    assert rig.ask("set-budget", bps=61_000).accepted, "the least that it names"


def test_what_x265_needs_binds_no_camera_that_is_passed_through():
    """A camera that takes little would keep a link that got thin to itself, or have to land for it."""
    rig = Rig("800kbps")
    rig.commands.config = replace(rig.config, encoder="passthrough")
    answer = rig.ask("set-budget", bps=10_000)
    assert (
        "10 kbps is too little for a camera that is passed through: it takes at least 13 kbps"
        in answer.reason
    )
    assert rig.ask("set-budget", bps=20_000).accepted
    assert rig.operating.now.budget_bps == 20_000


def test_the_budget_cannot_be_changed_all_the_time():
    """Each change costs a keyframe: a loop at a ground would leave no bits for anything else."""
    rig = Rig("800kbps")
    assert rig.ask("set-budget", bps=500_000).accepted
    assert "wait two seconds" in rig.ask("set-budget", bps=600_000).reason
    rig.request_ns += 2_000_000_000
    assert rig.ask("set-budget", bps=600_000).accepted


def test_another_method_decides_from_then_on():
    """Whoever finds out in flight that he needs other stills would have to land."""
    rig = Rig(name="M0", share=None)
    rig.run(5)
    assert rig.ask("set-method", method="m1").accepted
    assert rig.operating.now.method == "M1"
    rig.reconfiguration(1, rig.now_ns)
    assert rig.operating.now.base_bps == 0.8125 * 400_000, "stills have their share again"
    rig.run(60, others=True)
    assert rig.out.stills
    rig.request_ns += 2_000_000_000
    assert rig.ask("set-method", method="M0").accepted
    sent = len(rig.out.stills)
    rig.run(30, others=True)
    assert len(rig.out.stills) <= sent + 1
    for name in ("M99", "R0", 5):
        assert not rig.ask("set-method", method=name).accepted
    assert rig.operating.now.method == "M0"


def test_requests_of_another_session_and_floods_are_refused():
    """A request that waited on the link would hit the flight after; one loop would keep all others out."""
    rig = Rig()
    other = ControlRequest(session_id=SESSION + 1, command=Command.KEYFRAME, arguments={})
    assert "session has ended" in rig.commands.answer(other).reason
    mine = replace(other, session_id=0)
    answers = [rig.commands.answer(mine) for _ in range(40)]
    assert [one.accepted for one in answers] == [True] * 32 + [False] * 8
    assert "at most 32 a second" in answers[-1].reason
    rig.request_ns += 1_000_000_000
    assert rig.commands.answer(mine).accepted


@settings(max_examples=30)
@given(
    seed=st.integers(0, 2**32 - 1),
    totals=st.lists(st.sampled_from([200_000, 400_000, 800_000, 1_400_000]), min_size=2, max_size=4),
)
def test_after_a_change_every_message_keeps_to_the_budget_of_its_own_time(seed, totals):
    """The link that got thin would go on being flooded for a second after the operator said so."""
    rng = np.random.default_rng(seed)
    budget = RollingBudget(BudgetSettings(totals[0], round(0.8 * totals[0]), fps=15))
    sent: list[tuple[int, int]] = []
    for index in range(45 * len(totals)):
        total, keyframe = totals[index // 45], index % 45 == 0
        now_ns = START_NS + index * FRAME_NS
        if keyframe and index:
            budget.set_total(total, round(0.8 * total), 15.0, now_ns=now_ns)
        size = int(min(total / 8, 0.8 * total / 8 / 15 * rng.gamma(4, 0.25) * (4 if keyframe else 1)))
        at_ns = budget.earliest_ns(size, now_ns=now_ns, base=True)
        if at_ns - now_ns > 100_000_000 and not keyframe:
            continue  # the frame loop leaves out a frame that would have to wait
        budget.record_base(size, now_ns=at_ns, keyframe=keyframe)
        _check(sent, (at_ns, size), total)
        while (room := budget.still_allowance(now_ns)) > 300:
            still = int(rng.integers(300, room + 1))
            budget.record_still(still, now_ns=now_ns)
            _check(sent, (now_ns, still), total)


def _check(sent: list[tuple[int, int]], message: tuple[int, int], total_bps: int) -> None:
    """The window that ends with this message holds no more than the budget of its time."""
    sent.append(message)
    inside = sum(size for at_ns, size in sent if message[0] - 10**9 < at_ns <= message[0])
    assert inside <= total_bps / 8
