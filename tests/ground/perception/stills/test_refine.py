"""Stills find their own track, at their own frame, and say what it is."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_common.values import Posterior, iou
from hvt_ground.perception.history import History
from hvt_ground.perception.stills.match import Matcher
from hvt_ground.perception.stills.refine import MAX_HELD, Refiner
from hvt_ground.perception.stills.vocabulary import Vocabulary
from rigs.examples import seen, tracks_of
from rigs.footprint import footprint_bytes

DETECTOR = ("car", "van", "person")
CLASSIFIER = ("Person", "car", "van")
WORDS = Vocabulary(DETECTOR, CLASSIFIER)
FPS = 15
A = (100.0, 100.0, 140.0, 120.0)
B = (130.0, 100.0, 170.0, 120.0)  # beside A: IoU 0.14
A_NEAR = (106.0, 100.0, 146.0, 120.0)  # IoU with A 0.74, with B 0.25


def tracks(frame_index, boxes, *, born=None, classes=None, confidences=None):
    """Tracks at a frame from ``{id: box}``; all cars at 0.5 that were born at frame 0 unless said."""
    listed = {"born": born or {}, "classes": classes or {}, "confidences": confidences or {}}
    plain = {"born": 0, "classes": 0, "confidences": 0.5}
    values = {name: [of.get(one, plain[name]) for one in sorted(boxes)] for name, of in listed.items()}
    return tracks_of(frame_index, boxes, **values)


def says(*probabilities):
    """A classifier's answer over `CLASSIFIER`."""
    p = np.array(probabilities, np.float32)
    best = int(p.argmax())
    entropy = -float(sum(v * math.log(v) for v in probabilities if v > 0))
    return Posterior(CLASSIFIER[best], float(p[best]), entropy, p)


VAN = says(0.1, 0.2, 0.7)
PERSON = says(0.8, 0.1, 0.1)
CAR = says(0.05, 0.9, 0.05)


def still(
    sequence, frame_index, box=A, *, edge=70, posterior=VAN, class_name="car", words=WORDS, side_px=20.0
):
    """A still of an edge track."""
    posterior = words.vote(posterior, called=class_name, side_px=20.0)[0]
    return seen(sequence, frame_index, posterior, box, edge=edge, class_name=class_name, side_px=side_px)


class Ground:
    """A refiner and the history it looks into."""

    def __init__(self, mode="replace", *, words=WORDS, **settings):
        self.history = History(track_frames=100)
        self.now = -1
        self.refiner: Refiner = Refiner(mode, fps=FPS, vocabulary=words, **settings)

    def track(self, frame_index, boxes=None, **more):
        """Track a frame; None: decoded, but not tracked yet, or lost."""
        self.now = frame_index
        if boxes is not None:
            self.history.add_tracks(tracks(frame_index, boxes, **more))
        return self.settle()

    def settle(self):
        """What is settled now."""
        return self.refiner.settle(self.history, now_frame=self.now)

    def offer(self, *stills):
        """Offer stills and settle."""
        out = [done for one in stills for done in self.refiner.offer(one, now_frame=self.now)]
        return out + self.settle()

    def run(self, start, stop, boxes):
        """Track the same boxes from one frame to before another."""
        return [done for frame_index in range(start, stop) for done in self.track(frame_index, boxes)]


def brief(resolved):
    """(sequence, outcome, track) of each."""
    return [(done.event.still_sequence, done.outcome, done.event.track_id) for done in resolved]


@pytest.fixture
def ground():
    """A ground of the paper's rule."""
    return Ground()


def test_a_still_replaces_the_class_of_its_track(ground):
    """The whole point: the operator would go on reading what the thin base stream suggests."""
    ground.track(5, {1: A, 2: B})
    (done,) = ground.offer(still(0, 5))
    assert (done.event.track_id, done.event.class_before, done.event.class_after) == (1, "car", "van")
    assert done.event.confidence == pytest.approx(0.7)
    assert done.event.still == b"still 0"
    shown = ground.refiner.shown(tracks(6, {1: A, 2: B}, classes={2: 1}, confidences={2: 0.25}))
    assert shown.base_classes == ("car", "van")
    assert shown.classes == ("van", "van")
    assert shown.refined.tolist() == [True, False]
    np.testing.assert_allclose(shown.confidences, [0.7, 0.25], rtol=1e-6)
    assert (ground.refiner.tracks_refined, ground.refiner.class_changes) == (1, 1)


def test_the_frame_of_the_still_decides_not_the_present_one(ground):
    """A moving object's still would refine whatever has taken its place since."""
    ground.track(5, {1: A, 2: B})
    ground.track(6, {1: (70, 100, 110, 120), 2: A})
    assert brief(ground.offer(still(0, 5))) == [(0, "matched", 1)]


def test_a_missing_track_leaves_the_neighbour_alone(ground):
    """With its object lost on the ground, a still would rename the object beside it."""
    ground.track(5, {2: B})
    assert ground.offer(still(0, 5)) == []
    assert brief(ground.run(6, 5 + FPS + 1, {2: B})) == [(0, "no track", None)]
    assert not ground.refiner.shown(tracks(30, {2: B})).refined.any()


def test_a_close_neighbour_that_has_its_own_edge_track_is_left_alone(ground):
    """Two cars that overlap in the picture would swap classes when the ground loses one."""
    ground.track(5, {1: A, 2: A_NEAR})
    assert brief(ground.offer(still(0, 5, A, edge=70), still(1, 5, A_NEAR, edge=71))) == [
        (0, "matched", 1),
        (1, "matched", 2),
    ]
    ground.track(6, {2: A_NEAR})
    assert ground.offer(still(2, 6, A, edge=70)) == []
    assert brief(ground.run(7, 30, {2: A_NEAR})) == [(2, "no track", None)]
    ground.track(30, {2: A})
    assert brief(ground.offer(still(3, 30, A, edge=70))) == [(3, "matched", 2)], "a clear overlap corrects"


FIRST = still(0, 0)
OTHER = still(1, 0, A_NEAR, edge=71)


def rows(matcher, frame_index, boxes, *wanted):
    """The rows of the tracks that were found; -1 for none."""
    found = matcher.match(wanted, tracks(frame_index, boxes), later=(), class_names=DETECTOR)
    return [-1 if isinstance(one, str) else one[1] for one in (found[want.key] for want in wanted)]


@pytest.mark.parametrize(
    ("owned_frames", "steps"),
    [
        # When the edge gives an object a new id, its stills would be refused for the rest of the flight.
        (20, [(5, {1: A}, FIRST, 0), (25, {1: A}, OTHER, -1), (26, {1: A}, OTHER, 0)]),
        # After an exchange of ids on the ground, the second object would be refused as the first one's.
        (
            1000,
            [(5, {1: A}, FIRST, 0), (6, {1: (300, 100, 340, 120), 2: A}, FIRST, 1), (7, {1: A}, OTHER, 0)],
        ),
        # A late still from before an exchange of ids would bring the old posterior back: 2 is still the first one's.
        (1000, [(9, {2: A}, FIRST, 0), (5, {1: A}, FIRST, 0), (10, {2: A}, OTHER, -1)]),
    ],
    ids=["for a while", "until its owner has left", "whatever an older still shows"],
)
def test_a_track_is_another_edge_tracks_own(owned_frames, steps):
    """Objects that came near each other would get each other's class."""
    matcher = Matcher(least_iou=0.5, owned_frames=owned_frames)
    for frame, boxes, wanted, row in steps:
        assert rows(matcher, frame, boxes, wanted) == [row]


def test_a_lost_frame_refines_nothing(ground):
    """A still of a moment the ground never saw would be pinned on whatever was near before or after."""
    ground.track(5, {1: A})
    ground.track(8, {1: A})
    assert brief(ground.offer(still(0, 6))) == [(0, "frame lost", None)]


def test_a_still_waits_for_its_frame_to_be_tracked(ground):
    """When detection lags behind the stream, stills would come to nothing."""
    ground.track(5, {1: A})
    ground.track(9)
    assert ground.offer(still(0, 7)) == []
    assert ground.track(10) == []
    ground.history.add_tracks(tracks(6, {1: A}))
    assert ground.settle() == []
    ground.history.add_tracks(tracks(7, {1: A}))
    assert brief(ground.settle()) == [(0, "matched", 1)]


def test_a_still_waits_for_its_track_to_be_confirmed(ground):
    """The first still of an object, the one that tells what it is, would be thrown away."""
    ground.track(5, {2: B})
    ground.offer(still(0, 5))
    assert ground.track(6, {2: B}) == []
    assert brief(ground.track(7, {2: B, 3: A}, born={3: 4})) == [(0, "matched", 3)]


def test_a_track_born_after_the_still_is_another_object(ground):
    """The next car on the same spot would inherit the class of the one that left."""
    ground.track(5, {})
    ground.offer(still(0, 5))
    assert ground.track(6, {3: A}, born={3: 6}) == []
    assert brief(ground.run(7, 30, {3: A})) == [(0, "no track", None)]


def test_a_known_track_that_returns_is_not_taken_for_a_late_confirmation(ground):
    """A track that was elsewhere at the still's frame would be refined once it gets there."""
    ground.track(5, {2: B})
    ground.offer(still(0, 5))
    assert brief(ground.run(6, 30, {2: A})) == [(0, "no track", None)]


def test_a_still_whose_frame_never_comes_is_shown_unmatched(ground):
    """Stills would pile up unseen while the base stream is down."""
    ground.track(5, {1: A})
    assert ground.offer(still(0, 1 << 40)) == []
    given_up = {frame: brief(ground.track(frame)) for frame in range(6, 60)}
    assert {frame: done for frame, done in given_up.items() if done} == {51: [(0, "late", None)]}


def test_a_still_older_than_the_history_is_late(ground):
    """A still that sat in a queue for too long would be matched to nothing, without a word."""
    ground.run(0, 150, {1: A})
    assert brief(ground.offer(still(0, 3))) == [(0, "late", None)]


def test_what_still_waits_at_the_end_is_given_out(ground):
    """The last stills of a flight would be missing from its recording."""
    ground.offer(still(0, 3), still(1, 4))
    ended = ground.refiner.end()
    assert brief(ended) == [(0, "ended", None), (1, "ended", None)]
    assert (ended[0].event.class_before, ended[0].event.class_after) == ("car", "van")
    assert ended[0].event.confidence == pytest.approx(0.7)
    assert ground.refiner.end() == []


def test_two_stills_of_one_frame_go_to_two_tracks(ground):
    """Of two cars side by side one would get both answers and the other none."""
    middle = (112.0, 100.0, 152.0, 120.0)  # nearer to track 2, but track 2 is what the other still wants
    ground.track(5, {1: A, 2: (112.0, 100.0, 152.0, 120.0)})
    first = still(0, 5, A_NEAR, edge=70)
    assert iou(np.float32([A_NEAR]), np.float32([A, middle]))[0] == pytest.approx([0.739, 0.739], abs=1e-3)
    done = ground.offer(first)
    assert done == []
    assert brief(ground.offer(still(1, 5, middle, edge=71))) == [(0, "matched", 1), (1, "matched", 2)]


def test_what_cannot_be_told_apart_is_left_undecided(ground):
    """A coin would be tossed for which of two objects is renamed."""
    right = (112.0, 100.0, 152.0, 120.0)
    ground.track(5, {1: A, 2: right})
    ground.offer(still(0, 5, A_NEAR))
    assert brief(ground.run(6, 30, {1: A, 2: right})) == [(0, "ambiguous", None)]
    ground.track(40, {1: A, 2: right})
    ground.offer(still(1, 40, A))
    ground.track(41, {1: A, 2: right})
    assert brief(ground.offer(still(2, 41, A_NEAR))) == [(2, "matched", 1)], "an earlier still tells"


def test_two_boxes_on_one_object_are_told_by_class(ground):
    """A car that is also tracked as a van would never be refined, as if it were two objects."""
    double = (101.0, 100.0, 141.0, 120.0)
    ground.track(5, {1: A, 2: double}, classes={2: 1})
    between = (100.5, 100.0, 140.5, 120.0)
    assert brief(ground.offer(still(0, 5, between, class_name="van"))) == [(0, "matched", 2)]


def test_a_track_of_one_frame_is_claimed_once(ground):
    """A second edge track on the same frame would overwrite what the first has rightly said."""
    ground.track(5, {1: A})
    assert brief(ground.offer(still(0, 5, A, edge=70))) == [(0, "matched", 1)]
    ground.offer(still(1, 5, A, edge=71, posterior=PERSON))
    assert brief(ground.run(6, 30, {1: A})) == [(1, "no track", None)]
    assert ground.refiner.shown(tracks(30, {1: A})).classes == ("van",)


def test_stills_asked_for_by_box_have_no_edge_track(ground):
    """Two stills on demand would be taken for stills of one track, or block each other."""
    ground.track(5, {1: A, 2: B})
    done = ground.offer(still(0, 5, A, edge=-1), still(1, 5, B, edge=-1), still(2, 5, A, edge=70))
    assert brief(done)[:2] == [(0, "matched", 1), (1, "matched", 2)]


def test_the_newest_frame_wins_in_whatever_order_stills_come(ground):
    """A still that was late in the queue would undo what a newer one has shown."""
    ground.run(5, 9, {1: A})
    assert brief(ground.offer(still(4, 8, posterior=PERSON))) == [(4, "matched", 1)]
    (older,) = ground.offer(still(3, 6, posterior=VAN))
    assert brief([older]) == [(3, "superseded", 1)]
    assert (older.event.class_before, older.event.class_after) == ("person", "person")
    (newer,) = ground.offer(still(5, 8, posterior=CAR))
    assert (newer.event.class_before, newer.event.class_after) == ("person", "car")
    assert (ground.refiner.tracks_refined, ground.refiner.class_changes) == (1, 2)


def test_a_replayed_still_is_ignored(ground):
    """A repeated message would count twice, or bring an old answer back."""
    ground.run(5, 9, {1: A})
    done = ground.offer(still(0, 5), still(1, 6, posterior=PERSON))
    assert brief(done) == [(0, "matched", 1), (1, "matched", 1)]
    assert ground.offer(still(0, 8, posterior=VAN)) == []
    assert ground.refiner.shown(tracks(9, {1: A})).classes == ("person",)


def test_a_track_that_ended_is_forgotten(ground):
    """The ground would grow by every object it ever saw."""
    ground.track(5, {1: A})
    ground.offer(still(0, 5))
    assert ground.refiner.shown(tracks(155, {1: A})).refined.all()
    ground.refiner.shown(tracks(156, {}))
    assert ground.refiner.shown(tracks(300, {1: A})).refined.all(), (
        "a track that was hidden for less than 10 s"
    )
    ground.refiner.shown(tracks(451, {}))
    assert not ground.refiner.shown(tracks(452, {1: A})).refined.any()


@pytest.mark.parametrize(("base_then", "shown"), [(2, [2, 1]), (1, [2, 2])])
def test_who_takes_the_place_of_what_a_still_named_does_not_take_its_name(base_then, shown):
    """A car that stopped where a person had stood had the person's track, name and check mark."""
    ground = Ground("fuse", calibrated=True)
    ground.track(5, {1: A}, classes={1: base_then})
    ground.offer(still(0, 5, posterior=says(0.98, 0.01, 0.01)))
    names = [
        ground.refiner.shown(tracks(frame, {1: A}, classes={1: base}, confidences={1: 0.9})).classes
        for frame, base in ((6, 2), (60, 1))
    ]
    assert names == [(DETECTOR[one],) for one in shown], "a still that was right of a van stays so"


def test_a_flood_of_stills_is_bounded_and_given_out():
    """Anyone who can send a packet could fill the ground's memory."""
    ground = Ground()
    ground.track(5, {1: A})
    out, sizes = [], []
    for sequence in range(3 * MAX_HELD):
        out += ground.refiner.offer(still(sequence, 1 << 30, edge=sequence), now_frame=5)
    assert brief(out) == [(sequence, "overflow", None) for sequence in range(2 * MAX_HELD)]
    for sequence in range(10_000, 12_000):
        boxes = {sequence: A}
        ground.track(sequence, boxes)
        ground.offer(still(sequence, sequence, edge=sequence))
        ground.refiner.shown(
            tracks(sequence, dict.fromkeys(range(max(10_000, sequence - 20), sequence + 1), A))
        )
        if sequence % 500 == 499:
            sizes.append(footprint_bytes(ground.refiner))
    assert sizes[-1] < 1.2 * sizes[2], "twelve hundred tracks fill all that it remembers"


def test_fusing_multiplies_what_the_stills_say():
    """Two weak answers that agree would count no more than one, or the sum would be wrong."""
    moves = Vocabulary(("moving",), CLASSIFIER)  # the base has no vote: it says only that something moves
    ground = Ground("fuse", words=moves)
    ground.run(5, 10, {1: A})
    (first,) = ground.offer(still(0, 9, posterior=says(0.1, 0.6, 0.3), words=moves))
    assert (first.event.class_before, first.event.class_after) == ("moving", "car")
    assert first.event.confidence == pytest.approx(0.6, abs=1e-3)
    ground.track(10, {1: A})
    (second,) = ground.offer(still(1, 10, posterior=says(0.1, 0.2, 0.7), words=moves))
    assert (second.event.class_before, second.event.class_after) == ("car", "van")
    assert second.event.confidence == pytest.approx(0.21 / 0.34, abs=1e-3)
    assert ground.refiner.shown(tracks(11, {1: A})).classes == ("van",)


def test_fusing_counts_the_base_as_one_still():
    """What the base says in every frame would drown the stills, or not count at all."""
    ground = Ground("fuse")
    ground.run(5, 9, {1: A})
    ground.offer(still(0, 8, posterior=says(0.1, 0.42, 0.48)))
    for frame_index in range(9, 40):
        shown = ground.refiner.shown(tracks(frame_index, {1: A}, confidences={1: 0.8}))
    weights = np.array([0.1 * 0.1, 0.42 * 0.8, 0.48 * 0.1])
    assert shown.classes == ("car",)
    assert shown.confidences[0] == pytest.approx(weights[1] / weights.sum(), abs=1e-5)
    unsure = ground.refiner.shown(tracks(40, {1: A}, confidences={1: 0.2}))
    assert unsure.classes == ("car",), "a toss-up leaves the class as it is"
    assert unsure.confidences[0] == pytest.approx(0.42, abs=1e-5), "a confidence below 1/C says nothing"


def test_a_still_that_shows_nothing_new_says_nothing_new():
    """On a good base one more look at the same pixels would outvote all the looks before."""
    ground = Ground("fuse")
    ground.run(5, 9, {1: A})
    ground.offer(replace(still(0, 8, posterior=says(0.02, 0.08, 0.9)), news=0.0))
    ground.offer(replace(still(1, 8, posterior=says(0.02, 0.08, 0.9)), news=0.25))
    shown = ground.refiner.shown(tracks(9, {1: A}, confidences={1: 0.8}))
    weights = np.array([0.02**0.25 * 0.1, 0.08**0.25 * 0.8, 0.9**0.25 * 0.1])
    assert shown.classes == ("car",)
    assert shown.confidences[0] == pytest.approx(weights[1] / weights.sum(), abs=1e-4)


def test_fusing_survives_certainty_and_long_runs():
    """Certain answers would end in NaN, or one mistake would veto a class for ever."""
    ground = Ground("fuse")
    ground.run(0, 99, {1: A})
    ground.offer(still(0, 0, posterior=says(1.0, 0.0, 0.0)))
    ground.offer(*(still(n, n, posterior=says(0.0, 0.0, 1.0)) for n in range(1, 99)))
    shown = ground.refiner.shown(tracks(100, {1: A}))
    assert shown.classes == ("van",)
    assert shown.confidences[0] == pytest.approx(1.0)
    broken = says(0.2, 0.3, 0.5)
    broken.probabilities[0] = np.nan
    ground.track(101, {1: A})
    (done,) = ground.offer(still(200, 101, posterior=broken))
    assert done.event.class_after == "van"
    assert math.isfinite(done.event.confidence)


def test_a_posterior_over_other_classes_is_a_bug():
    """A classifier with another list of names would rename everything, plausibly and wrongly."""
    wrong = Posterior("car", 1.0, 0.0, np.ones(4, np.float32))
    with pytest.raises(ValueError, match="3 classes"):
        still(0, 5, posterior=wrong)


shares = st.lists(st.floats(0, 1, width=32), min_size=3, max_size=3).filter(lambda p: sum(p) > 0.01)


@settings(deadline=None, max_examples=60)
@given(
    answers=st.lists(shares, min_size=1, max_size=12),
    mode=st.sampled_from(["fuse", "replace"]),
    data=st.data(),
)
def test_the_order_in_which_stills_come_does_not_matter(answers, mode, data):
    """The same flight over another link would end with other classes."""
    stills = [
        still(n, n, posterior=says(*(np.array(answer) / sum(answer)).tolist()))
        for n, answer in enumerate(answers)
    ]
    seen = []
    for order in (stills, data.draw(st.permutations(stills))):
        ground = Ground(mode)
        ground.run(0, len(stills), {1: A})
        for one in order:
            ground.offer(one)
        shown = ground.refiner.shown(tracks(20, {1: A}, confidences={1: 0.6}))
        seen.append((shown.classes, shown.confidences.tolist()))
    assert seen[0] == seen[1]


steps = st.tuples(st.integers(0, 4), st.booleans(), st.integers(0, 3), st.integers(0, 8))


@settings(deadline=None, max_examples=100)
@given(script=st.lists(steps, min_size=1, max_size=40))
def test_objects_that_stand_apart_are_never_confused(script):
    """Whatever is lost, late or missing, an object would get the class of another."""
    spots = {n: (n * 60.0, 0.0, n * 60.0 + 40.0, 30.0) for n in range(1, 5)}
    ground = Ground()
    resolved, sent = [], 0
    for frame_index, (missing, lost, about, late) in enumerate(script):
        boxes = None if lost else {n: box for n, box in spots.items() if n != missing}
        resolved += ground.track(frame_index, boxes)
        edge = about + 1
        resolved += ground.offer(still(frame_index, max(0, frame_index - late), spots[edge], edge=edge))
        sent += 1
    resolved += ground.refiner.end()
    assert sorted(done.event.still_sequence for done in resolved) == list(range(sent)), (
        "each still comes out once"
    )
    for done in resolved:
        assert done.event.track_id in (None, done.event.edge_track_id)
        if done.event.track_id is not None:
            at_its_frame = ground.history.tracks(done.event.shown_at[0])
            assert at_its_frame is not None, "a lost frame refines nothing"
