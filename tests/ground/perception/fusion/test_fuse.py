"""One list from our own tracks, the edge's and the stills: each object once, under one id, where it is."""

from itertools import pairwise
from unittest import mock

import numpy as np
import pytest

from hvt_common.values import Tracks
from hvt_ground.perception.fusion.entity import CameraPath
from hvt_ground.perception.fusion.fuse import Fusion, unified_names
from rigs.examples import detections
from rigs.flight import tracks_at
from rigs.footprint import footprint_bytes

A = (100.0, 100.0, 140.0, 130.0)
B = (300.0, 100.0, 340.0, 130.0)
C = (500.0, 100.0, 540.0, 130.0)


BOXES = {"A": A, "B": B, "C": C}


def moved(box, dx, dy=0.0):
    return (box[0] + dx, box[1] + dy, box[2] + dx, box[3] + dy)


def box_of(word):
    """``A+20`` is 20 pixels to the right of A."""
    name, _, dx = word.partition("+")
    return moved(BOXES[name], float(dx or 0))


class Ground:
    """A fusion with our tracks of every frame."""

    def __init__(self, *, own=("car", "bus"), edge=("car", "bus"), **options) -> None:
        self.path = CameraPath(ahead_frames=15)
        self.names, places = unified_names(own, edge)
        self.fusion = Fusion(fps=15, edge_classes=places, path=self.path, **options)

    def own(self, index, boxes, **more):
        tracks = tracks_at(index, boxes, **more)
        self.fusion.take_own(tracks)
        return self.fusion.listed(tracks)

    def step(self, index, boxes, **more):
        self.fusion.take_step(tracks_at(index, boxes, **more), own=self.fusion.own_at(index))

    def found(self, index, *boxes):
        """Objects in a still of a frame, buses."""
        found = detections(boxes, classes=1)
        self.fusion.take_found(found, known=self.fusion.listed(self.fusion.own_at(index)).tracks)

    def told(self, story):
        """Frames of ours and steps of the edge, ``own 0 1=A 2=B; step 0 70=A+2``; what is listed in the end."""
        for act in story.split("; "):
            kind, index, *boxes = act.split()
            if kind == "found":
                self.found(int(index), *map(box_of, boxes))
                continue
            pairs = (one.split("=") for one in boxes)
            fused = getattr(self, kind)(int(index), {int(i): box_of(word) for i, word in pairs})
        return fused


def brief(fused):
    rows = zip(fused.tracks.ids.tolist(), fused.origins, fused.tracks.boxes_xyxy_px, strict=True)
    return {i: (origin, tuple(np.rint(box).astype(int).tolist())) for i, origin, box in rows}


def whole(box):
    return tuple(round(side) for side in box)


@pytest.fixture
def ground():
    return Ground()


ONE = "own 0 1=A; step 0 70=A; own 3 1=A+30"
ANEW = "own 0 1=A; step 0 70=B; own 1 1=A"
FIND = "own 0 1=A; found 0 A+3 B; own 1 1=A"


@pytest.mark.parametrize(
    ("story", "listed"),
    [
        # Every car that both sides see would be counted twice.
        ("own 0 1=A 2=B; step 0 70=A+2 71=C; own 1 1=A 2=B", "1=edge+base 2=base 3=edge@C"),
        # The operator would lose the car that he follows whenever the base gets better, or our tracker begins anew.
        (ANEW, "1=base 2=edge@B"),
        (f"{ANEW}; own 2 1=A 5=B", "1=base 2=edge+base"),
        (f"{ANEW}; own 2 1=A 5=B; own 3 1=A", "1=base 2=edge"),
        (f"{ANEW}; own 2 1=A 5=B; own 3 1=A; own 4 1=A 9=B", "1=base 2=edge+base"),
        # The edge's tracker may begin anew, too.
        (
            "own 0; step 0 70=A; step 5 70=A+15; step 10 70=A+30; own 15; step 15 88=A+45; own 16",
            "1=edge@A+48",
        ),
        # The edge sees one of two parked cars (IoU 0.25), we see the other: one of them would vanish.
        ("own 0 1=A; step 0 70=A+24; own 1 1=A", "1=base 2=edge"),
        # Boxes of the edge would stand still and jump three times a second, more where the step comes late.
        ("own 0; step 0 70=A; step 5 70=A+20; own 8", "1=edge@A+32"),
        ("own 0; own 5; own 8; step 0 70=A; step 5 70=A+20; own 9", "1=edge@A+36"),
        # A look of the edge that took long would put the car where it was, on an empty road.
        ("own 0; step 0 70=A; own 15", "1=edge@A"),
        ("own 0; step 0 70=A; own 16", ""),
        ("own 0; step 0 70=A; step 5 70=A+20; own 20", "1=edge@A+80"),
        ("own 0; step 0 70=A; step 5 70=A+20; own 25", ""),
        ("own 0; step 0 70=A; step 5 70=A+20; own 25; step 25 70=A+100; own 26", "1=edge@A+104"),
        # Between rare steps of the edge the class would flip.
        ("own 0 1=A; step 0 70=A; own 18 1=A+72", "1=edge+base"),
        # Cars that have driven away, or the list of an edge that has gone silent, would stay on the screen.
        ("own 0; step 0 70=A 71=B; step 5 71=B; own 6", "1=edge 2=edge"),
        ("own 0; step 0 70=A 71=B; step 5 71=B; step 10 71=B; own 11", "2=edge@B"),
        ("own 0; step 0 70=A 71=B; step 5 71=B; step 10 71=B; own 40", "2=edge"),
        ("own 0; step 0 70=A 71=B; step 5 71=B; step 10 71=B; own 41", ""),
        # A track that we see well would vanish with the edge's report.
        ("own 0 1=A; step 0 70=A; step 5; step 10; own 11 1=A", "1=base@A"),
        # Two cars that once overlapped would share one box between them for ever.
        (
            f"{ONE}; own 5 1=A+50; step 5 70=A; own 10 1=A+100; step 10 70=A; own 12 1=A+120",
            "1=edge@A 2=base@A+120",
        ),
        # Objects that only the sharp picture shows would never be listed, or for ever.
        (FIND, "1=base@A 2=still@B"),
        (f"{FIND}; own 30 1=A", "1=base 2=still"),
        (f"{FIND}; own 31 1=A", "1=base"),
        (f"{FIND}; own 2 1=A 7=B", "1=base 2=base@B"),
        ("own 0; found 0 B; step 5 70=B; own 6", "1=edge@B"),
        # One foreign message would bring back the past.
        ("own 0; step 5 70=A; step 5 70=B; step 3 70=B; own 6", "1=edge@A"),
    ],
)
def test_each_object_is_listed_once_under_its_id_where_it_is(ground, story, listed):
    """For as long as somebody knows of it, whoever saw it first: what would be lost is beside each story."""
    found = brief(ground.told(story))
    for one in listed.split():
        track_id, said = one.split("=")
        origin, _, place = said.partition("@")
        assert found.pop(int(track_id)) == (origin, whole(box_of(place)) if place else mock.ANY)
    assert not found


def test_without_an_edge_the_list_is_our_trackers(ground):
    """Whoever flies without the tracks channel would get other boxes, confidences or fewer tracks than before."""
    almost = moved(A, 1)  # two classes on one object: it is not for us to judge here
    ours = tracks_at(0, {3: A, 8: almost, 9: B})
    ours.class_ids[1] = 1
    ground.fusion.take_own(ours)
    fused = ground.fusion.listed(ours)
    assert fused.tracks.ids.tolist() == [1, 2, 3]
    assert fused.origins == ("base",) * 3
    for name in ("boxes_xyxy_px", "confidences", "class_ids", "born_frames", "seen_frames", "started"):
        np.testing.assert_array_equal(getattr(fused.tracks, name), getattr(ours, name), err_msg=name)


def test_of_two_that_fit_the_nearer_pair_is_one(ground):
    """Ids and classes of neighbours would be exchanged."""
    ground.own(0, {1: A, 2: moved(A, 20)})
    ground.step(0, {70: moved(A, 17), 71: moved(A, -3)})
    # If they were crossed, the boxes would be means of boxes 17 and 23 pixels apart.
    after = brief(ground.own(0 + 1, {1: A, 2: moved(A, 20)}))
    assert len(after) == 2
    assert abs(after[1][1][0] - 100) < 4
    assert abs(after[2][1][0] - 120) < 4


def test_between_steps_a_track_moves_along_with_the_camera(ground):
    """When the drone turns, the edge's boxes would lie beside their objects until the next step."""
    ground.own(0, {})
    ground.step(0, {70: A})
    for index in range(1, 4):
        ground.path.add(np.array([[1.0, 0, 10], [0, 1, -4]]), start=index - 1, end=index)
        fused = ground.own(index, {})
    assert brief(fused)[1][1] == whole(moved(A, 30, -12))
    ground.step(5, {70: moved(A, 50, -20)})  # it stands; all of its motion was the camera's
    ahead = ground.fusion.listed(tracks_at(6, {}))
    assert brief(ahead)[1][1] == whole(moved(A, 60, -24))


CROWD = {number: moved(A, 60 * number) for number in range(10)}
CROWD_AT_EDGE = {number + 70: box for number, box in CROWD.items()}
GHOST = (20, moved(A, 0, 200))
"""The base shows it, and nothing is there."""


def ghostly(index, confidence=0.5, **changes):
    """A list of ours with it, so sure."""
    tracks = tracks_at(index, {**CROWD, GHOST[0]: GHOST[1]})
    tracks.confidences[-1] = confidence
    for name, value in changes.items():
        getattr(tracks, name)[-1] = value
    return tracks


def with_ghost(ground, index, confidence=0.5, **changes):
    """A frame of ours in which it is seen; tell whether it is listed, and that everything else is."""
    tracks = ghostly(index, confidence, **changes)
    ground.fusion.take_own(tracks)
    return is_listed(ground, tracks)


def is_listed(ground, tracks):
    """Whether the ghost is, as ours."""
    listed = brief(ground.fusion.listed(tracks))
    assert {whole(box) for box in CROWD.values()} <= {box for _, box in listed.values()}
    return ("base", whole(GHOST[1])) in listed.values()


def ghost_id(ground, index):
    """The id that it is listed under."""
    return max(ground.fusion.listed(ground.fusion.own_at(index)).tracks.ids.tolist())


@pytest.mark.parametrize(
    ("before", "confidence", "step", "after"),
    [
        # At a thin link one in five that the base shows would be nothing that is in the source.
        (True, 0.5, CROWD_AT_EDGE, {1: False, 30: False, 31: True}),  # 31 frames without a step
        # The edge's detector makes errors too.
        (True, 0.95, CROWD_AT_EDGE, {1: True}),
        # An edge that reports what moves would take every parked car from the list.
        (True, 0.5, {70: CROWD[0], 71: CROWD[1]}, {1: True}),
    ],
)
def test_what_the_edge_does_not_see_in_its_source_is_not_there(ground, before, confidence, step, after):
    """Unless we are surer than it is thorough, it looks for other things, or has gone silent."""
    assert with_ghost(ground, 0, confidence) is before
    ground.step(0, step)
    assert {index: with_ghost(ground, index, confidence) for index in after} == after


def test_what_comes_to_the_edge_later_is_both_sides(ground):
    """What it has missed once would stay hidden."""
    with_ghost(ground, 0)
    ground.step(0, CROWD_AT_EDGE)
    ground.step(3, {**CROWD_AT_EDGE, 99: GHOST[1]})
    ground.own(4, {**CROWD, GHOST[0]: GHOST[1]})
    assert ("edge+base", whole(GHOST[1])) in brief(ground.own(5, {**CROWD, GHOST[0]: GHOST[1]})).values()


def test_what_is_new_since_the_last_step_is_listed(ground):
    """Who drives into the picture would be shown a third of a second late."""
    ground.own(0, CROWD)
    ground.step(0, CROWD_AT_EDGE)
    assert with_ghost(ground, 2)
    ground.step(2, CROWD_AT_EDGE)
    assert not with_ghost(ground, 3)


def test_what_a_still_has_shown_stays(ground):
    """The picture at hand would show what the list denies."""
    with_ghost(ground, 0)
    ground.fusion.take_box(ghost_id(ground, 0), GHOST[1], frame_index=0)
    for index in range(0, 155, 5):
        ground.step(index, CROWD_AT_EDGE)
        assert with_ghost(ground, index + 1), "for ten seconds after it"
    ground.step(155, CROWD_AT_EDGE)
    assert not with_ghost(ground, 156)


@pytest.mark.parametrize("is_known", [True, False])
def test_a_still_brings_back_what_was_doubted(ground, is_known):
    """The operator asks for a still of a place, sees a car in it, and the list has none until the next step."""
    with_ghost(ground, 0)
    doubted = ghost_id(ground, 0)
    ground.step(0, CROWD_AT_EDGE)
    assert not with_ghost(ground, 5)
    if is_known:
        ground.fusion.take_box(doubted, GHOST[1], frame_index=5)
    else:  # it shows an object that the list does not have
        ground.found(5, GHOST[1])
    assert with_ghost(ground, 6)


def test_an_edge_that_looks_less_often_is_given_two_looks(ground):
    """Its tracker has seen it once at most: what drives into the picture would be shown, hidden and shown again."""
    ground.own(10, CROWD)
    ground.step(10, CROWD_AT_EDGE)
    for index in range(12, 21):
        assert with_ghost(ground, index, born_frames=12)
        if index == 15:
            ground.step(15, CROWD_AT_EDGE)
            assert is_listed(ground, ghostly(15, born_frames=12))
    ground.step(20, CROWD_AT_EDGE)
    assert not with_ghost(ground, 21)


def test_people_whom_the_edge_never_finds_are_listed():
    """Beside many cars that both see, the ground's better network would be denied by the edge's small one."""
    ground = Ground(own=("car", "person"), edge=("car", "person"))
    cars = {number: moved(A, 60 * number) for number in range(40)}
    people = {50 + number: moved(A, 60 * number, 200) for number in range(5)}
    listed = []
    for index in range(0, 60, 5):
        tracks = tracks_at(index, {**cars, **people})
        tracks.class_ids[-5:], tracks.confidences[-5:] = 1, 0.7
        ground.fusion.take_own(tracks)
        ground.step(index, {number + 100: box for number, box in cars.items()})
        fused = brief(ground.fusion.listed(tracks)).values()
        listed.append(sum(("base", whole(box)) in fused for box in people.values()))
    assert listed[-8:] == [5] * 8


@pytest.mark.parametrize(
    "seen_as", [[(2, True)] * 6, [(0, False), (2, True)]], ids=["from the start", "later"]
)
def test_a_class_that_the_edge_cannot_name_is_ours_to_say(seen_as):
    """Boats would vanish beside the cars that both know; one first taken for a car would be hidden to the end."""
    ground = Ground(own=("car", "bus", "boat"), edge=("car", "bus"))
    for step, (class_id, expected) in enumerate(seen_as):
        with_ghost(ground, 5 * step, class_ids=class_id)
        ground.step(5 * step, CROWD_AT_EDGE)
        assert is_listed(ground, ghostly(5 * step, class_ids=class_id)) == expected


def test_what_the_edge_has_listed_may_be_missed_for_a_while(ground):
    """Whatever its detector misses now and then would blink."""
    with_ghost(ground, 0)
    ground.step(0, {**CROWD_AT_EDGE, 99: GHOST[1]})
    at_step = []
    for step in range(1, 10):
        ground.own(5 * step, {**CROWD, GHOST[0]: GHOST[1]})
        tracks = ghostly(5 * step, 0.3)
        for _ in range(4):
            ground.fusion.take_own(tracks)
        ground.step(5 * step, CROWD_AT_EDGE)
        at_step.append(any(box == whole(GHOST[1]) for _, box in brief(ground.fusion.listed(tracks)).values()))
    assert at_step == [True] * 5 + [False] * 4


def test_what_wavers_at_the_border_does_not_blink(ground):
    """The operator would take it for something that appears and disappears."""
    seen = []
    for step, confidence in enumerate(np.random.default_rng(5).uniform(0.68, 0.92, 60)):
        seen.append(with_ghost(ground, 5 * step, confidence))
        ground.step(5 * step, CROWD_AT_EDGE)
    assert sum(a != b for a, b in pairwise(seen)) <= 2


def test_a_box_of_the_edge_nearby_is_no_silence(ground):
    """Of a small object two boxes overlap little: ours would be denied, and the edge's is too unsure to be listed."""
    near = tracks_at(0, {**CROWD_AT_EDGE, 99: moved(GHOST[1], 25)})
    near.confidences[near.ids.tolist().index(99)] = 0.5
    with_ghost(ground, 0)
    ground.fusion.take_step(near, own=ghostly(0))
    assert is_listed(ground, ghostly(0))


def test_two_boxes_of_one_vehicle_count_once(ground):
    """A detector that says car and bus of one thing would cost precision twice."""
    ours = tracks_at(0, {1: A, 2: moved(A, 2), 3: B})
    ours.class_ids[1] = 1
    ground.fusion.take_own(ours)
    ground.step(0, {70: A, 71: C})
    fused = ground.fusion.listed(ours)
    assert brief(fused) == {1: ("edge+base", whole(A)), 3: ("base", whole(B)), 4: ("edge", whole(C))}


@pytest.mark.parametrize(
    ("finer", "confidence", "name", "shown"),
    [({}, 0.4, "bus", 0.6), ({}, 0.95, "car", 0.95), ({"base_per_source": 1 / 3}, 0.95, "bus", 0.95)],
)
def test_the_class_is_that_of_the_surer_side_and_of_who_saw_it_larger(finer, confidence, name, shown):
    """The edge would be overruled by a blurred base, or never; a truck of ten pixels there is surely called a car."""
    ground = Ground(**finer)
    ours, theirs = tracks_at(0, {1: A}), tracks_at(0, {70: A}, class_id=1)
    ours.confidences[:], theirs.confidences[:] = confidence, 0.6
    ground.fusion.take_own(ours)
    ground.fusion.take_step(theirs, own=ours)
    tracks = ground.fusion.listed(ours).tracks
    assert (ground.names[tracks.class_ids[0]], tracks.confidences[0]) == (name, pytest.approx(shown))


def test_names_that_only_the_edge_has_are_added():
    """A class of the edge's detector would be shown under the name of another."""
    ground = Ground(edge=("Bus", "truck"))
    ground.own(0, {})
    ground.step(0, {70: A}, class_id=1)
    fused = ground.own(1, {})
    assert [ground.names[i] for i in fused.tracks.class_ids] == ["truck"]


def test_both_boxes_are_weighed_by_age_and_confidence(ground):
    """The fresh box from the source would be dragged away by an old one on a bad base, or the other way round."""
    ground.own(0, {1: A})
    ground.step(0, {70: moved(A, 10)})
    fresh = ground.fusion.listed(tracks_at(0, {1: A})).tracks.boxes_xyxy_px[0, 0]
    assert fresh == pytest.approx(108), "the edge's counts four times"
    for index in range(1, 16):
        fused = ground.own(index, {1: A})
    assert fused.tracks.boxes_xyxy_px[0, 0] < 103, "ours is seen in every frame, theirs is a second old"


def test_a_stills_box_moves_the_track(ground):
    """The refined box would be thrown away, and the one on the bad base shown on."""
    ground.own(0, {1: A})
    ground.fusion.take_box(1, moved(A, 8), frame_index=0)
    first = ground.own(1, {1: A}).tracks.boxes_xyxy_px[0, 0]
    assert 102 < first <= 104
    later = ground.own(20, {1: A}).tracks.boxes_xyxy_px[0, 0]
    assert later < 100.5, "our tracker has seen it often since"
    ground.fusion.take_box(99, A, frame_index=20)  # a track that nobody knows
    ground.found(20, B)
    ground.fusion.take_box(2, moved(B, 6), frame_index=20)
    assert brief(ground.own(21, {}))[2] == ("still", whole(B)), "no newer than the find"


def test_two_that_turn_out_to_be_one_are_told(ground):
    """What stills have said of the one that goes would be lost."""
    apart = moved(A, 30)
    ground.own(0, {1: A})
    ground.step(0, {70: apart})
    assert set(brief(ground.own(1, {1: A}))) == {1, 2}
    assert ground.fusion.take_merged() == []
    ground.own(2, {1: apart})
    assert ground.fusion.take_merged() == [(1, 2)]
    assert ground.fusion.take_merged() == []
    assert {i: origin for i, (origin, _) in brief(ground.own(3, {1: apart})).items()} == {1: "edge+base"}


def test_looking_ahead_changes_nothing(ground):
    """What a study asks for at one frame would change what is shown at the next."""
    ground.own(0, {1: A})
    ground.step(0, {70: A, 71: B})
    before = brief(ground.fusion.listed(tracks_at(1, {1: A})))
    for index in (1, 5, 100, 3):
        ground.fusion.listed(tracks_at(index, {1: A}))
    assert brief(ground.fusion.listed(tracks_at(1, {1: A}))) == before


def test_tracks_of_a_step_that_make_no_sense_are_left_out(ground):
    """One foreign message would crash the ground."""
    ground.told("own 0; step 5 70=A")
    odd = tracks_at(6, {70: (9.0, 9, 5, 5), 71: B, 72: (np.nan, 0, 1, 1)})
    odd.class_ids[1] = 500
    ground.fusion.take_step(odd, own=None)
    assert brief(ground.own(6, {})) == {1: ("edge", whole(A))}


def test_what_leaves_the_picture_is_no_longer_there(ground):
    """Cut by the picture's edge it seems to stand still, and would be shown on an empty road."""
    ground.step(0, {7: (308, 0, 436, 106)})
    ground.step(7, {7: (308, 0, 436, 44)})
    assert [bool(ground.own(index, {}).origins) for index in (8, 22, 30)] == [True, True, False]


def test_memory_is_bounded(ground):
    """An edge whose tracker renumbers at each step would fill the ground's memory."""
    sizes = []
    for index in range(40):
        ground.own(index, {})
        tops = 15 + 20 * index
        ground.step(index, {200 * index + i: (10.0 * i, tops, 10.0 * i + 5, tops + 5.0) for i in range(200)})
        if index in (20, 39):
            sizes.append(footprint_bytes(ground.fusion))
    assert sizes[1] < 1.1 * sizes[0]
    for index in range(40, 400):
        ground.own(index, {})
    assert footprint_bytes(ground.fusion) < 0.2 * sizes[-1]


def test_random_scenes_never_list_an_object_twice_or_an_id_twice():
    """Some order of events would give two tracks one id."""
    random = np.random.default_rng(5)
    for _ in range(20):
        ground = Ground()
        homes = {i: (60.0 * i, 50.0, 60.0 * i + 30, 80.0) for i in range(8)}
        for index in range(40):
            seen = [i for i in homes if random.random() < 0.7]
            ours = {i + 10 * int(random.random() < 0.1): homes[i] for i in seen}
            fused = ground.own(index, ours)
            assert len(set(fused.tracks.ids.tolist())) == len(fused.tracks)
            assert fused.tracks.ids.tolist() == sorted(fused.tracks.ids.tolist())
            assert len(fused.tracks) <= len(homes)
            if index % 5 == 0:
                numbers = {i: i + 100 * int(random.random() < 0.2) for i in homes}
                jitter = {i: random.normal(0, 1.5, 4) for i in homes}
                step = {
                    numbers[i]: tuple((np.array(homes[i]) + jitter[i]).tolist())
                    for i in homes
                    if random.random() < 0.8
                }
                ground.step(index, step)
                assert isinstance(ground.fusion.own_at(index), Tracks)


@pytest.mark.parametrize("every_s", [0.3, 1.5, 3, 4.5])
def test_what_a_slow_edge_reports_stays_listed_from_one_report_to_the_next(ground, every_s):
    """An object that only the edge sees would vanish two seconds after each report, and come back with the next."""
    every = round(15 * every_s)
    for index in range(6 * every):
        if index % every == 0:
            ground.step(index, {7: A})
        fused = ground.own(index, {})
        assert fused.origins == ("edge",) or index < 2 * every
    gone = [len(ground.own(index, {}).origins) for index in range(6 * every, 6 * every + 300)]
    assert gone[-100:] == [0] * 100


# The camera's motion between any two frames, from that between decoded frames.


BOX = np.array([[100.0, 100.0, 120.0, 110.0]])


@pytest.mark.parametrize(
    ("start", "end", "moved"),
    [
        (0, 6, (5, 10)),
        (1, 6, (0, 10)),
        (0, 3, (5, 4)),  # evenly over the frames without a picture
        (3, 5, (0, 4)),
        (6, 8, (0, 4)),  # and on as it was
        (6, 40, (0, 20)),  # but not for ever
        (8, 10, (0, 4)),
        (-4, 1, (5, 0)),  # before the first it stood
        (6, 0, (-5, -10)),
        (4, 4, (0, 0)),
    ],
)
def test_boxes_move_with_the_camera(start, end, moved):
    """The edge's boxes would lie beside their objects wherever the drone turns."""
    path = CameraPath(ahead_frames=10)
    path.add(np.array([[1.0, 0, 5], [0, 1, 0]]), start=0, end=1)
    path.add(np.array([[1.0, 0, 0], [0, 1, 10]]), start=1, end=6)
    np.testing.assert_allclose(path.carry(BOX, start=start, end=end), BOX + np.tile(moved, 2), atol=1e-9)


def test_a_climbing_camera_makes_boxes_smaller_and_one_that_stands_moves_none():
    """Boxes would keep the size that they had before the drone rose, or move at random."""
    path = CameraPath(ahead_frames=5)
    assert path.carry(BOX, start=0, end=30) is BOX
    np.testing.assert_array_equal(path.between(3, 0), np.eye(2, 3))
    path.add(np.array([[0.5, 0, 0], [0, 0.5, 0]]), start=0, end=1)
    np.testing.assert_allclose(path.carry(BOX, start=0, end=1), BOX / 2)


def test_what_is_remembered_is_bounded():
    """A flight of hours would slow down with every frame."""
    path = CameraPath(ahead_frames=5, frames=8)
    for index in range(100):
        path.add(np.array([[1.0, 0, 1], [0, 1, 0]]), start=index, end=index + 1)
    assert path.between(0, 100)[0, 2] == pytest.approx(8)
