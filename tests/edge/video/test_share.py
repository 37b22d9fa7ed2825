"""``--video-share auto``: the split follows the scene, at keyframes, and does not waver."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_edge.operating import FIRST_SHARE, AutoDecisions, Operating, Rates
from hvt_edge.perception.candidates import BaseLoss, Candidate, ClassPosterior
from hvt_edge.stills.policy.base import CostEstimate, Step
from hvt_edge.video.reconfigure import EncoderReconfiguration, Split
from rigs.examples import candidate, decision_step

SECOND = 1_000_000_000


def moment(seconds: float, *, from_source: bool = False) -> Step:
    return decision_step(
        round(seconds * 15),
        now_ns=round(seconds * SECOND),
        cost=CostEstimate(150, 0.1, 700),
        allowance_bytes=2000,
        from_source=from_source,
    )


def car(track_id: int, *, lost: float, confidence: float = 0.6, side: float = 30, **changes) -> Candidate:
    box = (100.0, 100.0, 100 + side, 100 + side)
    plain = {"frame_index": 0, "confidence": confidence, "crop_area_px": 1.69 * side * side}
    return candidate(track_id, box, **(plain | {"loss": lambda: BaseLoss(28.0, lost)} | changes))


def split(total_bps: int, **changes) -> Split:
    """At 720p15."""
    return Split(total_bps=total_bps, least_base_bps=90_000, **changes)


def crowd(count: int, *, side: float = 90, **changes) -> list[Candidate]:
    """Tracks of which the base has lost most."""
    return [car(number, side=side, **({"lost": 0.9} | changes)) for number in range(1, count + 1)]


def after(one: Split, scene: list[Candidate], *, seconds: float = 10, start: float = 0, **kind) -> float:
    """What is proposed when the scene was like that for some seconds, three steps a second; 0 for no change."""
    for number in range(round(seconds * 3)):
        one.observe(scene, moment(start + number / 3, **kind))
    return one.propose() or 0.0


def reconfiguration_of(operating: Operating, its_split: Split, open_encoder) -> EncoderReconfiguration:
    return EncoderReconfiguration(
        operating,
        size=(1280, 720),
        nominal_fps=15,
        least_fps=2,
        edge_id="e",
        min_budget_bps=50_000,
        metadata_bps=its_split.metadata_bps,
        open_encoder=open_encoder,
        budget=SimpleNamespace(set_total=lambda *_rates, **_when: None),
        split=its_split,
    )


def test_an_empty_scene_gives_the_bits_to_the_base_and_a_crowd_to_stills():
    """Bits would lie idle where nothing is to refine, or a crowd of blurs would stay one."""
    assert after(split(300_000), []) == 0.95
    assert after(split(300_000), crowd(59), from_source=True) == 0.65
    assert 0.85 < after(split(300_000), crowd(8), from_source=True) < 0.95


def test_settled_tracks_give_their_bits_back():
    """The base would stay poor for the sake of classes that are already known."""
    one, scene = split(300_000), crowd(59)
    assert after(one, scene, from_source=True) == 0.65
    sent = {"sent_count": 1, "last_sent_ns": 10 * SECOND, "posterior": ClassPosterior("car", 0.97, 0.1)}
    known = [replace(track, last_sent_area_px=track.area_px, **sent) for track in scene]
    share = after(one, known, start=10, seconds=8, from_source=True)
    assert share > 0.8
    assert one.share == share


def test_at_a_thin_rate_the_base_keeps_what_it_needs_to_show_objects():
    """At 150 kbps every bit taken from a base that still shows its cars costs more cars than stills give back."""
    assert after(split(150_000), crowd(59, lost=0.2, confidence=0.75, side=60)) * 150_000 > 140_000
    # A base that shows none of its objects has nothing to lose: down to what x265 can follow.
    blind = crowd(199, lost=0.98, confidence=0.5, side=12)
    assert 90_000 <= after(split(150_000), blind, from_source=True) * 150_000 < 110_000


def test_the_tracks_channel_comes_out_of_the_total():
    """Base, stills and tracks together would be promised more than there is."""
    assert after(split(200_000, metadata_bps=10_000), []) == 0.9
    share = after(split(200_000, metadata_bps=10_000), crowd(89, lost=0.95, side=30), from_source=True)
    assert 0 < 1 - share - 0.05 <= 0.35 + 1e-9


def test_nothing_is_proposed_before_the_scene_is_known_or_for_a_trifle():
    """The encoder would be opened anew at every keyframe, 35 ms and a poor first picture each time."""
    one = split(300_000)
    assert one.propose() is None
    assert one.share == FIRST_SHARE
    after(one, crowd(50, side=60), from_source=True)
    settled = one.share
    for start, count in ((10, 48), (20, 51)):
        assert after(one, crowd(count, side=60), start=start, from_source=True) == 0
    assert one.share == settled


@settings(max_examples=60)
@given(
    total=st.sampled_from([100_000, 150_000, 300_000, 800_000]),
    metadata=st.sampled_from([0, 8_000]),
    scenes=st.lists(
        st.tuples(st.integers(0, 120), st.floats(0, 1), st.floats(0.1, 1), st.booleans()),
        min_size=1,
        max_size=6,
    ),
)
def test_the_share_is_the_same_every_time_and_leaves_x265_what_it_needs(total, metadata, scenes):
    """A flight could not be repeated, or would end because x265 cannot follow its rate."""

    def flight() -> list[float]:
        one, shares = split(total, metadata_bps=metadata), []
        for number, (count, lost, confidence, source) in enumerate(scenes):
            scene = crowd(count, side=30, lost=lost, confidence=confidence)
            shares.append(after(one, scene, seconds=2, start=2 * number, from_source=source))
        return shares

    shares = flight()
    assert flight() == shares
    for share in filter(None, shares):
        assert min(90_000, total - metadata) - 0.005 * total - 1 <= share * total
        assert 0 < share <= min(1, 1 - metadata / total + 0.005)
        assert share == pytest.approx(round(share, 2))


def test_a_scene_that_has_changed_is_worth_a_keyframe_of_its_own_now_and_then():
    """On a thin link scheduled keyframes are a minute apart: the split would follow the scene of a minute ago."""
    one = split(300_000)
    assert not one.wants_keyframe(60 * SECOND), "nothing is known of the scene"
    one.observe(crowd(59), moment(0, from_source=True))
    assert not one.wants_keyframe(19 * SECOND), "not so soon"
    assert one.wants_keyframe(20 * SECOND)
    assert one.propose() == 0.65
    assert not one.wants_keyframe(60 * SECOND), "it is as it should be"
    for number in range(60):
        one.observe([], moment(1 + number / 3, from_source=True))
    assert one.wants_keyframe(40 * SECOND), "the crowd has gone"


def test_of_few_frames_the_base_takes_no_more_than_they_may_take_time():
    """Each frame of half as many has twice the bits, and is on the line for twice as long."""
    one = split(300_000, most_sparse_share=0.9)
    for number in range(60):
        one.observe([], moment(number / 3))
    one.set_beside(metadata_bps=0, stills=False, sparse=True)
    assert one.propose() == 0.9
    one.set_beside(metadata_bps=60_000, stills=False, sparse=True)
    assert one.propose() == 0.8
    one.set_beside(metadata_bps=0, stills=False, sparse=False)
    assert one.propose() == 1.0
    near = split(300_000, most_sparse_share=0.97)
    near.share = 1.0
    near.observe([], moment(0))
    near.set_beside(metadata_bps=0, stills=False, sparse=True)
    assert near.propose() == 0.97, "however small the change"
    thin = split(95_000, most_sparse_share=0.9)
    thin.observe([], moment(0))
    thin.set_beside(metadata_bps=0, stills=False, sparse=True)
    thin.share = 1.0
    assert thin.propose() == 0.95, "x265 cannot follow less"


def test_reconfiguration_tells_the_split_how_many_frames_are_coded():
    """With half the frames the base would take all that stills leave, and each would arrive late."""
    operating = Operating(budget_bps=300_000, video_share=None, base_bps=300_000, method="M6", decimation=1)
    opened = []
    reconfiguration = reconfiguration_of(operating, split(300_000, most_sparse_share=0.9), opened.append)
    operating.set(decisions=AutoDecisions(stills=False))
    reconfiguration.split.observe([], moment(0))
    for decimation, share in ((2, 0.9), (1, 1.0)):
        reconfiguration(decimation, SECOND)
        assert opened[-1] == Rates(300_000, share * 300_000, decimation)


def test_what_stills_leave_while_they_pause_goes_back_to_the_base():
    """A tenth of a thin link would lie idle until the next scheduled keyframe, up to a minute later."""
    operating = Operating(budget_bps=300_000, video_share=None, base_bps=255_000, method="M6", decimation=2)
    reconfiguration = reconfiguration_of(
        operating, split(300_000, metadata_bps=8_000), lambda _rates: pytest.fail("only a keyframe opens it")
    )
    for number in range(60):
        reconfiguration.split.observe(crowd(8), moment(number / 3, from_source=True))
    assert not reconfiguration.wants_keyframe(30 * SECOND)
    operating.set(decisions=AutoDecisions(stills=False))
    assert reconfiguration.wants_keyframe(30 * SECOND)
