"""Stills find their own track, at their own frame, and say what it is."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_common.values import Posterior
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
BOXES = {
    "A": A,
    "B": (130.0, 100.0, 170.0, 120.0),  # beside A: IoU 0.14
    "N": (106.0, 100.0, 146.0, 120.0),  # near A: IoU with A and with M 0.74, with B 0.25
    "M": (112.0, 100.0, 152.0, 120.0),
    "D": (101.0, 100.0, 141.0, 120.0),  # a double of A
    "H": (100.5, 100.0, 140.5, 120.0),  # halfway between A and D
    "O": (300.0, 100.0, 340.0, 120.0),
}


def tracks(frame_index, boxes, *, born=None, classes=None, confidences=None):
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
        return self.refiner.settle(self.history, now_frame=self.now)

    def offer(self, *stills):
        out = [done for one in stills for done in self.refiner.offer(one, now_frame=self.now)]
        return out + self.settle()

    def run(self, start, stop, boxes):
        return [done for frame_index in range(start, stop) for done in self.track(frame_index, boxes)]

    def told(self, story):
        """Do what it says, as in ``track 5 1=A 2=B; late 6; offer 0 5 A``; what came of each still, and when.

        ``track 5-9`` are frames, ``track 7 3=A born=4`` what was seen earlier, ``late`` one that is not tracked yet,
        ``offer 0 5 A 71 van`` a still of frame 5 and edge track 71, which takes a van for one.
        """
        done = []
        for act in story.split("; "):
            kind, *words = act.split()
            if kind == "offer":
                box, edge, name = [*words[2:], *("A", "70", "car")[len(words) - 2 :]]
                one = still(int(words[0]), int(words[1]), BOXES[box], edge=int(edge), class_name=name)
                done += [(self.now, one) for one in self.offer(one)]
                continue
            first, _, last = words[0].partition("-")
            said = dict(one.split("=") for one in words[1:])
            more = {name: {3: int(said.pop(name))} for name in ("born", "classes") if name in said}
            boxes = None if kind == "late" else {int(i): BOXES[box] for i, box in said.items()}
            for frame_index in range(int(first), int(last or first) + 1):
                if frame_index < self.now:
                    self.history.add_tracks(tracks(frame_index, boxes))
                    done += [(self.now, one) for one in self.settle()]
                else:
                    done += [(frame_index, one) for one in self.track(frame_index, boxes, **more)]
        return [(one.event.still_sequence, one.outcome, one.event.track_id, now) for now, one in done]


def brief(resolved):
    return [(done.event.still_sequence, done.outcome, done.event.track_id) for done in resolved]


@pytest.fixture
def ground():
    """A ground of the paper's rule."""
    return Ground()


def test_a_still_replaces_the_class_of_its_track(ground):
    """The whole point: the operator would go on reading what the thin base stream suggests."""
    both = {1: A, 2: BOXES["B"]}
    ground.track(5, both)
    (done,) = ground.offer(still(0, 5))
    event = done.event
    assert (event.track_id, event.class_before, event.class_after, event.still) == (
        1,
        "car",
        "van",
        b"still 0",
    )
    assert event.confidence == pytest.approx(0.7)
    shown = ground.refiner.shown(tracks(6, both, classes={2: 1}, confidences={2: 0.25}))
    assert (shown.base_classes, shown.classes) == (("car", "van"), ("van", "van"))
    assert shown.refined.tolist() == [True, False]
    np.testing.assert_allclose(shown.confidences, [0.7, 0.25], rtol=1e-6)
    assert (ground.refiner.tracks_refined, ground.refiner.class_changes) == (1, 1)


BOTH = "track 5 1=A 2=N; offer 0 5 A 70; offer 1 5 N 71"
FOUND = [(0, "matched", 1, 5), (1, "matched", 2, 5)]


@pytest.mark.parametrize(
    ("story", "outcomes"),
    [
        # A moving object's still would refine whatever has taken its place since.
        ("track 5 1=A 2=B; track 6 1=O 2=A; offer 0 5", [(0, "matched", 1, 6)]),
        # With its object lost on the ground, a still would rename the object beside it.
        ("track 5 2=B; offer 0 5; track 6-25 2=B", [(0, "no track", None, 20)]),
        # Two cars that overlap in the picture would swap classes when the ground loses one.
        (f"{BOTH}; track 6 2=N; offer 2 6; track 7-25 2=N", [*FOUND, (2, "no track", None, 21)]),
        (f"{BOTH}; track 30 2=A; offer 3 30", [*FOUND, (3, "matched", 2, 30)]),  # a clear overlap corrects
        # A still of a moment that the ground never saw would be pinned on whatever was near before or after.
        ("track 5 1=A; track 8 1=A; offer 0 6", [(0, "frame lost", None, 8)]),
        # When detection lags behind the stream, stills would come to nothing.
        ("track 5 1=A; late 9; offer 0 7; late 10; track 6 1=A; track 7 1=A", [(0, "matched", 1, 10)]),
        # The first still of an object, the one that tells what it is, would be thrown away.
        ("track 5 2=B; offer 0 5; track 6 2=B; track 7 2=B 3=A born=4", [(0, "matched", 3, 7)]),
        # The next car on the same spot would inherit the class of the one that left.
        ("track 5; offer 0 5; track 6 3=A born=6; track 7-25 3=A", [(0, "no track", None, 20)]),
        # A track that was elsewhere at the still's frame would be refined once it gets there.
        ("track 5 2=B; offer 0 5; track 6-25 2=A", [(0, "no track", None, 20)]),
        # Stills would pile up unseen while the base stream is down.
        (f"track 5 1=A; offer 0 {1 << 40}; late 6-59", [(0, "late", None, 51)]),
        # A still that sat in a queue for too long would be matched to nothing, without a word.
        ("track 0-149 1=A; offer 0 3", [(0, "late", None, 149)]),
        # Of two cars side by side one would get both answers: 2 is nearer to the second still's box.
        ("track 5 1=A 2=M; offer 0 5 N 70; offer 1 5 M 71", [(0, "matched", 1, 5), (1, "matched", 2, 5)]),
        # A coin would be tossed for which of two objects is renamed, unless an earlier still tells.
        ("track 5 1=A 2=M; offer 0 5 N; track 6-25 1=A 2=M", [(0, "ambiguous", None, 20)]),
        (
            "track 40 1=A 2=M; offer 1 40 A 0; track 41 1=A 2=M; offer 2 41 N 0",
            [(1, "matched", 1, 40), (2, "matched", 1, 41)],
        ),
        # A car that is also tracked as a van would never be refined, as if it were two objects.
        ("track 5 1=A 3=D classes=1; offer 0 5 H 70 van", [(0, "matched", 3, 5)]),
        # A second edge track on the same frame would overwrite what the first has rightly said.
        (
            "track 5 1=A; offer 0 5 A 70; offer 1 5 A 71; track 6-25 1=A",
            [(0, "matched", 1, 5), (1, "no track", None, 20)],
        ),
        # Two stills on demand would be taken for stills of one track, or block each other.
        (
            "track 5 1=A 2=B; offer 0 5 A -1; offer 1 5 B -1; offer 2 5 A 70",
            [(0, "matched", 1, 5), (1, "matched", 2, 5), (2, "matched", 1, 5)],
        ),
    ],
)
def test_a_still_finds_its_own_track_at_its_own_frame_or_none(ground, story, outcomes):
    """What would be lost is beside each story."""
    assert ground.told(story) == outcomes


FIRST = still(0, 0)
OTHER = still(1, 0, BOXES["N"], edge=71)


@pytest.mark.parametrize(
    ("owned_frames", "steps"),
    [
        # When the edge gives an object a new id, its stills would be refused for the rest of the flight.
        (20, [(5, {1: A}, FIRST, 0), (25, {1: A}, OTHER, None), (26, {1: A}, OTHER, 0)]),
        # After an exchange of ids on the ground, the second object would be refused as the first one's.
        (1000, [(5, {1: A}, FIRST, 0), (6, {1: BOXES["O"], 2: A}, FIRST, 1), (7, {1: A}, OTHER, 0)]),
        # A late still from before an exchange of ids would bring the old posterior back: 2 is still the first one's.
        (1000, [(9, {2: A}, FIRST, 0), (5, {1: A}, FIRST, 0), (10, {2: A}, OTHER, None)]),
    ],
    ids=["for a while", "until its owner has left", "whatever an older still shows"],
)
def test_a_track_is_another_edge_tracks_own(owned_frames, steps):
    """Objects that came near each other would get each other's class."""
    matcher = Matcher(least_iou=0.5, owned_frames=owned_frames)
    for frame, boxes, wanted, row in steps:
        found = matcher.match([wanted], tracks(frame, boxes), later=(), class_names=DETECTOR)[wanted.key]
        assert (None if isinstance(found, str) else found[1]) == row


def test_what_still_waits_at_the_end_is_given_out(ground):
    """The last stills of a flight would be missing from its recording."""
    ground.offer(still(0, 3), still(1, 4))
    ended = ground.refiner.end()
    assert brief(ended) == [(0, "ended", None), (1, "ended", None)]
    assert (ended[0].event.class_before, ended[0].event.class_after) == ("car", "van")
    assert ended[0].event.confidence == pytest.approx(0.7)
    assert ground.refiner.end() == []


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
    assert ground.refiner.shown(tracks(300, {1: A})).refined.all(), "hidden for less than 10 s"
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
        ground.track(sequence, {sequence: A})
        ground.offer(still(sequence, sequence, edge=sequence))
        ground.refiner.shown(tracks(sequence, {sequence: A}))
        if sequence % 500 == 499:
            sizes.append(footprint_bytes(ground.refiner))
    assert sizes[-1] < 1.2 * sizes[2], "twelve hundred tracks fill all that it remembers"


def test_fusing_multiplies_what_the_stills_say():
    """Two weak answers that agree would count no more than one, or the sum would be wrong."""
    moves = Vocabulary(("moving",), CLASSIFIER)  # the base has no vote: it says only that something moves
    ground = Ground("fuse", words=moves)
    ground.run(5, 11, {1: A})
    told = []
    for sequence, said in enumerate((says(0.1, 0.6, 0.3), says(0.1, 0.2, 0.7))):
        (done,) = ground.offer(still(sequence, 9 + sequence, posterior=said, words=moves))
        told += [done.event.class_before, done.event.class_after, done.event.confidence]
    sure = [pytest.approx(one, abs=1e-3) for one in (0.6, 0.21 / 0.34)]
    assert told == ["moving", "car", sure[0], "car", "van", sure[1]]
    assert ground.refiner.shown(tracks(11, {1: A})).classes == ("van",)


@pytest.mark.parametrize(
    ("stills", "base", "weights"),
    [
        # What the base says in every frame would drown the stills, or not count at all.
        ([((0.1, 0.42, 0.48), 1.0)], 0.8, (0.1 * 0.1, 0.42 * 0.8, 0.48 * 0.1)),
        # A confidence below 1/C says nothing, and a toss-up leaves the class as it is.
        ([((0.1, 0.42, 0.48), 1.0)], 0.2, (0.1, 0.42, 0.48)),
        # On a good base one more look at the same pixels would outvote all the looks before.
        (
            [((0.02, 0.08, 0.9), 0.0), ((0.02, 0.08, 0.9), 0.25)],
            0.8,
            (0.02**0.25 * 0.1, 0.08**0.25 * 0.8, 0.9**0.25 * 0.1),
        ),
    ],
)
def test_fusing_counts_the_base_as_one_still_and_a_still_by_its_news(stills, base, weights):
    """See each case."""
    ground = Ground("fuse")
    ground.run(5, 9, {1: A})
    for sequence, (said, news) in enumerate(stills):
        ground.offer(replace(still(sequence, 8, posterior=says(*said)), news=news))
    for frame_index in range(9, 40):
        shown = ground.refiner.shown(tracks(frame_index, {1: A}, confidences={1: base}))
    assert shown.classes == ("car",)
    assert shown.confidences[0] == pytest.approx(weights[1] / sum(weights), abs=1e-4)


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


shares = st.lists(st.floats(0, 1, width=32), min_size=3, max_size=3).filter(lambda p: sum(p) > 0.01)


@settings(max_examples=60)
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


@given(script=st.lists(steps, min_size=1, max_size=40))
def test_objects_that_stand_apart_are_never_confused(script):
    """Whatever is lost, late or missing, an object would get the class of another."""
    spots = {n: (n * 60.0, 0.0, n * 60.0 + 40.0, 30.0) for n in range(1, 5)}
    ground = Ground()
    resolved = []
    for frame_index, (missing, lost, about, late) in enumerate(script):
        boxes = None if lost else {n: box for n, box in spots.items() if n != missing}
        resolved += ground.track(frame_index, boxes)
        edge = about + 1
        resolved += ground.offer(still(frame_index, max(0, frame_index - late), spots[edge], edge=edge))
    resolved += ground.refiner.end()
    assert sorted(done.event.still_sequence for done in resolved) == list(range(len(script))), "each once"
    for done in resolved:
        assert done.event.track_id in (None, done.event.edge_track_id)
        if done.event.track_id is not None:
            at_its_frame = ground.history.tracks(done.event.shown_at[0])
            assert at_its_frame is not None, "a lost frame refines nothing"
