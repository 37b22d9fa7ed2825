"""Words on the picture are readable: beside their own object, over no other, and only where there is a reason."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from hvt_ground.events import Overlay
from hvt_ground.sinks.rerun.labels import Word, place_labels, place_legend
from hvt_ground.sinks.rerun.still_places import Gallery
from programs import rrd
from programs.rrd import Recording
from rigs.examples import refinement

SIZE = (1280, 720)


def areas(labels, size=SIZE):
    """What the texts cover, reckoned for a picture that is 900 points wide: 7.2 a letter, 25 high."""
    unit = size[0] / 900
    for one in labels:
        half, (x, y) = (7.2 * len(one.text) + 12) * unit / 2, one.at_px
        yield np.array([x - half, y, x + half, y + 25 * unit])


def overlap(a, b) -> bool:
    return bool((np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]) > 1e-6).all())


corners = st.tuples(st.integers(0, 1200), st.integers(0, 660), st.integers(8, 300), st.integers(8, 300))


@given(spots=st.lists(corners, min_size=1, max_size=40), speaking=st.integers(1, 40))
def test_no_label_covers_another_object_or_another_label(spots, speaking):
    """Labels would hide half of a dense scene."""
    boxes = np.array([[x, y, x + w, y + h] for x, y, w, h in spots], np.float64)
    words = [Word(row, f"{row + 100} truck ✓") for row in range(min(speaking, len(boxes)))]
    labels = place_labels(words, boxes, size=SIZE, sides={})
    covered = list(areas(labels))
    for number, (one, area) in enumerate(zip(labels, covered, strict=True)):
        assert (area[:2] >= -1e-6).all()
        assert (area[2:] <= np.array(SIZE) + 1e-6).all()
        assert not any(overlap(area, box) for row, box in enumerate(boxes) if row != one.row)
        assert not any(overlap(area, other) for other in covered[number + 1 :])


def test_a_label_stays_on_its_side():
    """It would jump about with every step of the object."""
    boxes = np.array([[600.0, 300, 680, 340]])
    (first,) = place_labels([Word(0, "7 van")], boxes, size=SIZE, sides={})
    assert first.at_px == (640.0, 340.0)
    (again,) = place_labels([Word(0, "7 van")], boxes, size=SIZE, sides={0: 1})
    assert again.side == 1
    assert again.at_px[1] < 300
    crowded = np.vstack([boxes, [[590.0, 200, 690, 299]]])
    (moved,) = place_labels([Word(0, "7 van")], crowded, size=SIZE, sides={0: 1})
    assert moved.side == 0


def test_the_legend_is_below_the_picture_and_does_not_collide():
    """Colours would have to be known by heart, or the legend would cover the picture."""
    names = ["car", "pedestrian", "awning-tricycle", "bus"]
    places = place_legend(names, size=SIZE)
    assert all(y > SIZE[1] for _, y in places)
    widths = [(7.2 * len(name) + 12) * SIZE[0] / 900 for name in names]
    for (x, _), (other, _), mine, theirs in zip(places, places[1:], widths, widths[1:], strict=False):
        assert x + mine / 2 <= other - theirs / 2


def recorded(path: Path, *events) -> Recording:
    return Recording(rrd.recorded(path, events, base_size=SIZE))


def overlay(frame: int = 0, **changes) -> Overlay:
    """Four cars; a still has spoken on the last three: a van, a shrub, a car."""
    boxes = np.array([[100.0 + 200 * i, 300, 160 + 200 * i, 340] for i in range(4)], np.float32)
    values = {
        "frame_index": frame,
        "capture_ns": 1_790_000_000_000_000_000 + frame * 66_666_667,
        "track_ids": np.arange(1, 5),
        "boxes_base_px": boxes,
        "base_classes": ("car",) * 4,
        "classes": ("car", "van", "other", "car"),
        "confidences": np.array([0.4, 0.95, 0.97, 0.95], np.float32),
        "refined": np.array([False, True, True, True]),
        "doubted": np.array([False, False, True, False]),
        "sure": np.array([False, True, False, True]),
    }
    return Overlay(**(values | changes))


def test_words_stand_where_a_still_renamed_or_doubts(tmp_path):
    """A word at each of sixty cars says nothing of the one that matters."""
    read = recorded(tmp_path / "a.rrd", overlay())
    assert {track: text for track, (text, _) in read.words(0).items()} == {2: "2 van ✓", 3: "3 car?"}
    boxes = read.boxes(0)
    assert {track: box.doubted for track, box in boxes.items()} == {1: False, 2: False, 3: True, 4: False}
    assert (boxes[3].class_before, boxes[3].class_after) == ("car", "other")
    plain = overlay(1, classes=("car",) * 4, doubted=np.zeros(4, np.bool_))
    gone = recorded(tmp_path / "b.rrd", overlay(), plain)
    assert gone.words(1) == {}, "a word whose reason is gone is gone"


def test_what_is_not_sure_has_no_check_mark(tmp_path):
    """The .95 of a model that was never calibrated would look like a fact."""
    read = recorded(tmp_path / "a.rrd", overlay(sure=np.zeros(4, np.bool_)))
    assert {text for text, _ in read.words(0).values()} == {"2 van", "3 car?"}


def test_brightness_follows_the_probability(tmp_path):
    """A guess and a certainty would look alike."""
    guessed = overlay(1, confidences=np.full(4, 0.7, np.float32), sure=np.zeros(4, np.bool_))
    read = recorded(tmp_path / "a.rrd", overlay(), guessed)
    unsure, sure = (ink(read, "/base/tracks", 0)[0], ink(read, "/base/refined", 0))
    assert unsure < ink(read, "/base/tracks", 1)[0] < sure[1]
    assert sure[1] > ink(read, "/base/refined", 1)[1]


def ink(read: Recording, entity: str, frame: int) -> list[int]:
    """The brightness of each box of a layer."""
    (context,) = read.rows(entity, "AnnotationContext:context")[-1][2]
    colours = {one["class_id"]: one["class_description"]["info"]["color"] for one in context}
    return [
        sum(colours[number] >> shift & 255 for shift in (8, 16, 24))
        for number in read.latest(entity, "Boxes2D:class_ids", frame)
    ]


REFINED = refinement(
    capture_ns=1_790_000_000_000_000_000, track_id=4, box_base_px=(700, 300, 760, 340), confidence=0.95
)
"""A still of a car that is one."""


def test_an_object_that_somebody_chose_is_named(tmp_path):
    """The operator asked for a still of track 4 and would have to look for it among sixty."""
    asked = dataclasses.replace(REFINED, reason="asked", sure=True)
    read = recorded(tmp_path / "a.rrd", asked, overlay(1))
    assert read.words(1)[4][0] == "4 car ✓"
    other = recorded(tmp_path / "b.rrd", dataclasses.replace(asked, reason="utility"), overlay(1))
    assert 4 not in other.words(1)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"sure": True}, "track 4: car ✓ .95"),
        ({}, "track 4: car .95"),
        ({"class_after": "van"}, "track 4: car → van .95"),
        ({"class_after": "van", "vague": (False, True)}, "track 4: car → vehicle .95"),
        ({"class_before": "van", "class_after": "bus", "vague": (True, True)}, "track 4: vehicle .95"),
        ({"class_after": "other", "doubted": True}, "track 4: doubted, car? other .95"),
        ({"class_before": "other", "class_after": "other", "doubted": True}, "track 4: doubted, other .95"),
        ({"doubted": True}, "track 4: doubted, car? .95"),
        (
            {"track_id": None, "unread": True, "note": "waffle iron .31"},
            "edge track 5: car (waffle iron .31)",
        ),
    ],
)
def test_the_log_says_what_a_still_did(tmp_path, changes, text):
    """What is doubted would be found nowhere, and a note of the classifier would pass for a class."""
    still = dataclasses.replace(REFINED, **changes)
    ((_, _, line),) = recorded(tmp_path / "a.rrd", still).events()
    assert text in line
    assert ("✓" in line) == bool(changes.get("sure"))


def test_the_colours_that_are_shown_stand_in_the_legend(tmp_path):
    """A stranger would not know that blue is a car."""
    read = recorded(tmp_path / "a.rrd", overlay(), overlay(1, base_classes=("bus", "car", "car", "car")))
    legend = set(read.rows("/base/legend", "Points2D:labels")[-1][2])
    assert legend == {"car", "van", "other", "something", "bus"}


@given(events=st.lists(st.tuples(st.booleans(), st.integers(0, 60)), max_size=60))
@hypothesis_settings(max_examples=300)
def test_each_pair_is_held_for_a_while_whatever_comes_when(events):
    """Pairs would flicker by, or an old one would push out what is shown at its time."""
    gallery, newest, taken = Gallery(3, hold_ns=2), 0, set()
    for live, number in events:
        # Stills of now come in their order, those of the past at any time between them.
        frame = newest + 1 + number % 5 if live else number
        if not live and frame > newest:
            continue
        newest = max(newest, frame)
        slot = gallery.put(frame, frame, changed=False) if live else gallery.put_stored(frame, frame)
        if slot is not None:
            assert all(abs(frame - other) >= 2 for of, other in taken if of == slot)
            taken.add((slot, frame))


def test_an_old_still_holds_its_slot_for_a_while_only_where_one_is_free():
    """Pairs would flicker by, or an old one would push out what is shown now."""
    gallery = Gallery(2, hold_ns=10)
    live = [(0, 0), (1, 0), (100, 100)]
    assert [gallery.put(frame, at_ns, changed=False) for frame, at_ns in live] == [0, 1, 0]
    assert [gallery.put_stored(frame, frame) for frame in (50, 55, 57, 95)] == [0, 1, None, 1]


def test_what_is_too_long_ago_to_tell_finds_no_slot():
    """Memory would grow with every still of a flight of weeks."""
    gallery = Gallery(1, hold_ns=10)
    for frame in range(0, 6000, 10):
        assert gallery.put(frame, frame, changed=False) == 0
    assert gallery.put_stored(5, 5) is None
    assert gallery.put(7000, 7000, changed=False) == 0
    assert gallery.put_stored(6500, 6500) == 0
