"""From tracks to stills, with the real codec; every request has one outcome."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_common.values import Frame, View
from hvt_common.video.still_codecs import JpegCodec
from hvt_edge.link.stills import Still
from hvt_edge.perception.analyzer import AnalyzedFrame
from hvt_edge.perception.candidates import Candidate, TrackMemory
from hvt_edge.perception.frame_ring import FrameRing
from hvt_edge.stills.maker import StillMaker
from hvt_edge.stills.on_demand import OnDemand
from hvt_edge.stills.outbox import Outbox, OutboxSettings, OutboxStill
from hvt_edge.stills.policy.base import CostModel, Request, Step, ranked
from hvt_edge.stills.scheduler import Chooser, Gate, Suppression
from media.base_coded import StandIn
from media.clips import START_NS, hard_pictures
from rigs.examples import tracks_of
from rigs.messages import still_of

SIZE = (640, 360)
PICTURE = hard_pictures(1, size=SIZE)[0]
FLAT = np.full_like(PICTURE, 128)
STEP_NS = 333_333_333


@dataclass(frozen=True)
class ByScore:
    """Wants every candidate; the score is its id, or what is given for it."""

    scores: tuple[tuple[int, float], ...] = ()
    name: str = "by-score"
    video_only: bool = False

    def requests(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:
        scores = dict(self.scores)
        return ranked(
            candidates, score=lambda one: scores.get(one.track_id, float(one.track_id)), reason="test"
        )


class Rig:
    """A chooser, its outcomes, and steps of a third of a second."""

    def __init__(
        self,
        method: ByScore | None = None,
        *,
        cooldown: float = 0.0,
        most_bytes: int = 20_000,
        picture: np.ndarray = PICTURE,
        maker: StillMaker | None = None,
        **settings,
    ) -> None:
        self.picture, self.memory = picture, TrackMemory()
        self.outcomes: Counter[tuple[str, str]] = Counter()
        view = View.fitted(SIZE, SIZE, fit="letterbox")
        self.steps: list[tuple[Sequence[Candidate], Step]] = []
        self.outbox = Outbox(OutboxSettings(max_pending=3))
        on_demand = OnDemand(
            FrameRing(max_bytes=0),
            outbox=self.outbox,
            maker=maker or StillMaker(),
            view=view,
            class_names=("car",),
            line=None,
        )
        self.chooser = Chooser(
            method or ByScore(),
            suppression=Suppression.for_cooldown(cooldown),
            memory=self.memory,
            on_demand=on_demand,
            fps=3,
            most_bytes=most_bytes,
            **settings,
            on_outcome=lambda outcome, reason: self.outcomes.update([(outcome, reason)]),
            observe=lambda candidates, step: self.steps.append((candidates, step)),
        )
        self.number = -1
        self.sent: list[Still] = []

    @property
    def now_ns(self) -> int:
        return START_NS + self.number * STEP_NS

    def consider(self, boxes: dict[int, tuple[float, ...]], *, base=FLAT, detected: bool = True) -> None:
        self.number += 1
        tracks = tracks_of(self.number, boxes)
        seen = AnalyzedFrame(
            Frame(self.number, self.now_ns, self.picture, self.picture), base, tracks, detected=detected
        )
        self.chooser.consider(seen, now_ns=self.now_ns, allowance_bytes=1000)

    def coded(self, allowance: int) -> list[OutboxStill]:
        coded, left = [], [allowance]
        for one in self.chooser.stills(now_ns=self.now_ns, allowance=lambda _still: left[-1]):
            assert len(one.still.data) <= left[-1]
            left.append(left[-1] - len(one.still.data))
            coded.append(one)
            self.sent.append(one.still)
            self.outcomes["sent", "again" if one.copies > 1 else one.still.header.reason] += 1
        return coded

    def stills(self, allowance: int) -> list[int]:
        return [one.track_id for one in self.coded(allowance)]


SMALL, LARGE = (20.0, 20.0, 60.0, 50.0), (150.0, 50.0, 500.0, 330.0)


def box_at(number: int, side: float = 36.0) -> tuple[float, ...]:
    x, y = 10.0 + 45 * (number % 12), 10.0 + 45 * (number // 12)
    return x, y, x + side, y + side


def test_the_most_useful_is_sent_first_as_long_as_there_is_room():
    """The bits would go to whatever was seen first, or starve what matters behind what happens to be small."""
    rig = Rig()
    rig.consider({1: box_at(1), 3: box_at(3), 2: box_at(2)})
    assert rig.stills(100_000) == [3, 2, 1]
    assert rig.outcomes == {("sent", "test"): 3}
    assert len(rig.outbox) == 0
    rig = Rig(ByScore(((1, 1.0), (2, 2.0))))
    rig.consider({1: SMALL, 2: LARGE})
    assert rig.stills(2_500) == []
    assert len(rig.outbox) == 2
    rig.consider({1: SMALL, 2: LARGE, 3: box_at(5)}, detected=False)
    assert rig.stills(60_000) == [2, 1], "between detections nothing is requested, but what is pending may go"


def test_one_that_never_fits_does_not_block_the_others_for_ever():
    """One lorry close to the camera would keep every other still from being sent for the rest of the flight."""
    rig = Rig(ByScore(((1, 1.0), (2, 2.0))))
    sent: list[int] = []
    for _ in range(12):
        rig.consider({1: SMALL, 2: LARGE})  # requested again at each step, so that none grows old
        sent += rig.stills(2_500)
    assert set(sent) == {1}
    assert len(sent) >= 3
    assert rig.outcomes["dropped", "too_large"] >= 2


def test_one_that_waited_long_is_coded_to_the_room_there_is():
    """An object that is believed to need a little more than its share would never be seen sharp at all."""
    rig = Rig(picture=cv2.GaussianBlur(PICTURE, (0, 0), 3))  # codes to far less than is expected
    expected = 640 + 0.12 * 208 * 208
    sent = []
    for _ in range(4):
        rig.consider({2: (20.0, 20.0, 180.0, 180.0)})
        sent.append(rig.stills(round(expected * 0.8)))
    assert sent == [[], [], [], [2]], "a second of waiting"


def test_what_the_base_shows_as_well_is_not_sent():
    """Bits would be spent on stills that show nothing new."""
    rig = Rig()
    rig.consider({1: SMALL}, base=PICTURE)
    assert rig.stills(100_000) == []
    assert rig.outcomes == {("dropped", "base_good"): 1}
    rig.consider({1: SMALL}, base=PICTURE)
    assert rig.stills(100_000) == []
    assert rig.outcomes["deferred", "refused"] == 1, "it rests before it is tried again"


def test_sequence_numbers_count_stills_and_nothing_else():
    """The ground would believe that stills were lost."""
    rig = Rig()
    numbers = []
    for step in range(4):
        rig.consider({1: SMALL, 2: box_at(7)}, base=PICTURE if step % 2 else FLAT)
        numbers += [one.still.header.sequence for one in rig.coded(10**6)]
        rig.number += 3  # past the rest of what was refused
    assert numbers == list(range(len(numbers)))
    assert len(numbers) >= 4


NEIGHBOURS = {1: (20.0, 20.0, 44.0, 40.0), 2: (46.0, 22.0, 70.0, 42.0), 3: (400.0, 200.0, 440.0, 240.0)}
BASE_CODED = StillMaker(codec=StandIn(), fallback=JpegCodec())
BLURRED = cv2.GaussianBlur(PICTURE, (0, 0), 3)


def test_neighbours_share_a_still_and_all_of_them_count_as_sent():
    """Headers would be paid twice for one place, or the neighbour sent again right after."""
    rig = Rig(share=True, cooldown=5.0)
    rig.consider(NEIGHBOURS)
    assert rig.stills(100_000) == [3, 2]
    (alone, pair), shared_bytes = (one.header for one in rig.sent), len(rig.sent[1].data)
    assert (alone.also, [one.track_id for one in pair.also]) == ((), [1])
    assert pair.crop_source_px == (16, 17, 74, 45)
    assert rig.outcomes == {("sent", "test"): 2}, "one for each still"
    rig.consider(NEIGHBOURS)
    assert [one.sent_count for one in rig.steps[-1][0]] == [1, 1, 1]
    assert rig.stills(100_000) == []
    assert rig.outcomes["deferred", "cooldown"] == 3
    plain = Rig()
    plain.consider(NEIGHBOURS)
    assert plain.stills(100_000) == [3, 2, 1], "the paper's methods send what the paper says"
    learnt = CostModel.of_codec("jpeg")
    for area_px, size_bytes in ((52 * 52, len(rig.sent[0].data)), (58 * 28, shared_bytes)):
        learnt.observe(area_px=area_px, size_bytes=size_bytes)
    assert rig.steps[-1][1].cost == learnt.estimate(), "the cost is learnt by what a still codes"


def test_the_gate_holds_back_what_the_base_shows_well_before_the_method_chooses():
    """The places in the queue would go to stills that add little."""
    good = BLURRED.copy()
    good[:, 320:] = PICTURE[:, 320:]
    good[:, 320:] = cv2.add(good[:, 320:], (3, 3, 3, 0))  # a little too bright: 38 dB, and no edge is lost
    boxes = {track: box_at(track) for track in (1, 2)} | {9: (450.0, 100.0, 500.0, 140.0)}
    rig = Rig(gate=Gate(psnr_y_db=36.0))
    rig.consider(boxes, base=good)
    assert rig.outcomes == {("dropped", "base_good"): 1}
    assert rig.stills(100_000) == [2, 1]
    rig.consider(boxes, base=good)
    assert rig.outcomes["deferred", "refused"] == 1
    ungated = Rig(maker=BASE_CODED)
    ungated.consider(boxes, base=good)
    assert 9 in ungated.stills(100_000)


def test_stills_that_build_on_the_base_wait_for_a_frame_that_has_one():
    """A step on a frame that is not coded would be lost, or its stills be sent without what they build on."""
    rig = Rig(maker=BASE_CODED)
    rig.consider({1: SMALL}, base=None)
    assert rig.stills(100_000) == []
    rig.consider({1: SMALL}, base=BLURRED, detected=False)
    assert rig.stills(100_000) == [1]
    assert (rig.sent[0].header.codec, rig.sent[0].header.frame_index) == ("stand-in", 1)
    rig.consider({1: SMALL}, base=BLURRED, detected=False)
    assert rig.stills(100_000) == [], "one step, one decision"
    plain = Rig(cooldown=60.0)
    plain.consider({1: SMALL}, base=None)
    assert plain.stills(100_000) == [1], "what needs no base waits for none"
    plain.outbox.on_undecodable(0)
    plain.consider({1: SMALL})
    assert plain.stills(100_000) == [], "and a forged request does not double what a ground has"


@settings(max_examples=25)
@given(
    st.lists(
        st.tuples(st.sets(st.integers(0, 30), max_size=6), st.integers(0, 6_000), st.booleans()),
        min_size=1,
        max_size=15,
    ),
    st.sampled_from([0.0, 1.0]),
    st.sampled_from([0.0, 30.0]),
)
def test_every_candidate_of_a_step_has_exactly_one_outcome(steps, cooldown, gate_db):
    """The table of outcomes would not add up to the candidates there were."""
    rig, candidates = Rig(cooldown=cooldown, gate=Gate(psnr_y_db=gate_db)), 0
    for tracks, room, good in steps:
        rig.consider({one: box_at(one) for one in sorted(tracks)}, base=PICTURE if good else FLAT)
        candidates += len(tracks)
        rig.stills(room)
        assert len(rig.outbox) <= 3
    rig.chooser.close()
    assert sum(rig.outcomes.values()) == candidates


class LossRig(Rig):
    """A chooser with stills that were sent two seconds ago, and that a report ought to have named."""

    def lose(self, *losses: tuple[int, float, int]) -> None:
        self.number = 0
        for track, utility, size in losses:
            still = still_of(bytes(size), sequence=self.outbox.sequence(store=False), track_id=track)
            one = OutboxStill(replace(still, crop_bgr=PICTURE[:4, :4]), None, utility, 0)
            self.outbox.sent(one, still, now_ns=self.now_ns - 2 * STEP_NS * 3)
        self.outbox.on_report(-1, (), now_ns=self.now_ns)
        self.number = -1

    def sent_tracks(self, allowance: int = 100_000) -> list[tuple[int, float]]:
        return [(one.track_id, one.utility) for one in self.coded(allowance)]


def test_a_lost_still_goes_before_pending_ones_that_are_less_useful():
    """The link's loss would decide what is seen, not the policy."""
    rig = LossRig()
    rig.lose((50, 2.5, 400), (51, 0.5, 400))
    rig.consider({1: box_at(1), 2: box_at(3), 3: box_at(5)})
    assert rig.sent_tracks() == [(3, 3.0), (50, 2.5), (2, 2.0), (1, 1.0), (51, 0.5)]
    assert rig.outcomes == {("sent", "test"): 3, ("sent", "again"): 2}
    assert rig.outbox.sequence(store=False) == 5, "a second copy takes no number"
    assert rig.sent_tracks() == [], "once"


def test_a_lost_still_that_is_not_allowed_holds_up_nobody():
    """A large one would let all others grow old, and then be too old itself."""
    rig = LossRig()
    rig.lose((50, 9.0, 9_000))
    rig.consider({1: SMALL})
    assert rig.sent_tracks(8_999) == [(1, 1.0)]
    assert rig.sent_tracks(9_000) == [(50, 9.0)]
    rig = LossRig()
    rig.lose((3, 9.0, 400))
    rig.consider({3: SMALL})
    assert rig.sent_tracks(10) == []
    assert rig.sent_tracks()[0] == (3, 3.0), "a newer still of its track shows the present, not the past"


def test_what_is_allowed_next_to_nothing_waits_for_an_allowance_that_helps():
    """Each scrap of the budget would go at once to a still that shows nothing, and none be left for one that does."""
    rig = Rig(maker=StillMaker(least_bytes=400), most_bytes=300)
    rig.consider({1: box_at(1)})
    assert rig.stills(399) == []
    assert len(rig.outbox) == 1
    assert rig.stills(20_000) == [1]
