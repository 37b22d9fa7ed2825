"""What stands there and is hardly believed has no name."""

import numpy as np
import pytest

from hvt_common.values import Tracks
from hvt_ground.perception.guesses import Guesses
from hvt_ground.perception.stills.refine import ViewTilt
from rigs.examples import tracks_of

Thing = tuple[str, float, tuple[float, float], float]
"""Class, confidence, middle, side."""
STEP = np.array([[1.0, 0.0, 3.0], [0.0, 1.0, -2.0]])


def tracks(frame: int, things: list[Thing]) -> Tracks:
    """All of them seen at this frame."""
    boxes = [(x - side / 2, y - side / 4, x + side / 2, y + side / 4) for _, _, (x, y), side in things]
    return tracks_of(frame, boxes, confidences=[one[1] for one in things])


def guessed(things: list[Thing], *, moves_px: float = 0.0) -> list[int]:
    """Places of the guesses in the end, under a camera that pans; the last of them moves so far a frame."""
    guesses = Guesses(fps=10)
    for frame in range(50):
        shift = STEP[:, 2] * frame + np.zeros((len(things), 2))
        shift[-1, 0] += moves_px * frame
        shown = [
            (name, score, (x + by[0], y + by[1]), side)
            for (name, score, (x, y), side), by in zip(things, shift, strict=True)
        ]
        guesses.update(tracks(frame, shown), [one[0] for one in shown], STEP)
    return np.flatnonzero(guesses.among(np.arange(1, len(things) + 2))).tolist()


ROW: list[Thing] = [("car", 0.8, (100.0 * one, 200.0), 90.0) for one in range(5)]
POST: Thing = ("pedestrian", 0.44, (900.0, 400.0), 12.0)
PIT: Thing = ("pedestrian", 0.55, (900.0, 400.0), 12.0)
WAITS: Thing = ("pedestrian", 0.75, (930.0, 400.0), 12.0)
PLANTER: Thing = ("bus", 0.43, (500.0, 60.0), 216.0)
FAINT: Thing = ("van", 0.35, (500.0, 500.0), 80.0)
HALF: Thing = ("van", 0.6, (125.0, 200.0), 40.0)
BESIDE: Thing = ("van", 0.6, (125.0, 260.0), 80.0)
BONNET: Thing = ("van", 0.6, (80.0, 200.0), 40.0)


@pytest.mark.parametrize(
    ("things", "moves_px", "guesses"),
    [
        # A stranger saw two pedestrians who never took a step, as firm as the cars beside them.
        ([*ROW, POST], 0, [5]),
        ([*ROW, POST], 1, []),
        ([PIT], 0, [0]),
        ([WAITS, WAITS, WAITS, PIT], 0, [3]),  # lane marks stand in rows
        ([WAITS], 0, []),  # a surer one may stand and wait
        ([PIT] * 5, 0, [0, 1, 2, 3, 4]),  # five pits do not vouch for each other
        # A planter between the rows was a bus; to leave out what stands would leave out the rows.
        ([*ROW, FAINT, PLANTER], 0, [6]),
        ([*ROW[:2], FAINT], 0, [2]),  # two say little of what is usual
        # A van was a van and, by half of its roof, a car: two boxes as firm as each other on one vehicle.
        ([*ROW, BESIDE, HALF], 0, [6]),
        ([*ROW, BONNET], 0.8, [5]),  # a part moves with the whole
    ],
)
def test_what_stands_and_is_hardly_believed_is_a_guess(things, moves_px, guesses):
    """See each case."""
    assert guessed(things, moves_px=moves_px) == guesses


def test_a_camera_that_is_followed_a_little_wrongly_moves_nothing():
    """In a minute of hovering every post would have walked away from where it stood."""
    guesses = Guesses(fps=10)
    for frame in range(600):
        listed = tracks(frame, [("pedestrian", 0.4, (500.0 + 0.05 * frame, 400.0), 30.0)])
        guesses.update(listed, ["pedestrian"], None)
    assert guesses.among(np.array([1])).tolist() == [True]


@pytest.mark.parametrize(
    ("said", "aslant", "known"),
    [
        (["car"] * 4, True, True),
        (["truck"] * 4, False, True),
        (["truck"] * 4, True, False),
        (["truck", "car"] * 2, False, False),
        (["car", "car", "truck"], False, False),
    ],
)
def test_a_kind_is_known_where_detections_agree_on_it(said, aslant, known):
    """A parked car was a truck in one second and a car in the next, each as firm as a car that never was another."""
    guesses = Guesses(fps=10)
    for frame, name in enumerate(said):
        guesses.update(tracks(frame, [(name, 0.95, (500.0, 400.0), 30.0)]), [name], None)
    assert guesses.agreed(np.array([1]), said[-1:], aslant=aslant).tolist() == [known]
    assert not guesses.agreed(np.array([2]), said[-1:], aslant=aslant).any(), "one that was never seen"


# Vehicles tell whether the camera looks aslant.


NAMES = ("car", "pedestrian")


def vehicles(growth: float, *, seed: int, count: int = 6) -> Tracks:
    """Cars, and a truck among them, ``growth`` times larger at the bottom than at the top."""
    rng = np.random.default_rng(seed)
    rows = rng.uniform(40, 680, count)
    sides = 30 * growth ** (rows / 720) * rng.uniform(0.8, 1.25, count)
    sides[0] *= 2
    left = rng.uniform(0, 1200, count)
    return tracks_of(0, np.column_stack((left, rows - sides / 2, left + sides, rows + sides / 2)))


@pytest.mark.parametrize(
    "views",
    [[(1.0, False)], [(1.5, False)], [(2.5, True)], [(6.0, True)], [(6.0, True), (1.0, False), (6.0, True)]],
)
def test_sizes_that_grow_down_the_picture_tell_also_of_a_gimbal_that_turns(views):
    """A class would have a check mark that is right every second time; or none after a look at the horizon."""
    tilt = ViewTilt()
    for growth, aslant in views:
        for seed in range(30 if len(views) > 1 else 8):
            tilt.take(vehicles(growth, seed=seed), NAMES, height_px=720)
        assert tilt.aslant is aslant


def test_too_few_tell_nothing():
    """Two cars, of which one is a truck, would tilt the camera."""
    tilt = ViewTilt()
    tilt.take(tracks_of(0, [[0, 0, 20, 20], [0, 600, 60, 660]]), NAMES, height_px=720)
    tilt.take(Tracks.none(1), NAMES, height_px=720)
    assert tilt.aslant is None
    for _ in range(30):  # side by side
        tilt.take(tracks_of(0, [[0, 300, 20, 320], [80, 300, 140, 360]]), NAMES, height_px=720)
    assert tilt.aslant is None


@pytest.mark.parametrize("changes", [{"classes": 1}, {"seen": -1}], ids=["people", "carried on"])
def test_what_is_no_vehicle_or_was_not_just_seen_tells_nothing(changes):
    """Their sizes say nothing of the view, and a track that is only carried on keeps its size."""
    tilt = ViewTilt()
    for seed in range(8):
        boxes = vehicles(6.0, seed=seed).boxes_xyxy_px
        tilt.take(tracks_of(0, boxes, **changes), NAMES, height_px=720)
    assert tilt.aslant is None
