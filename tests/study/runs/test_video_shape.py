"""The strongest competitor: video alone at its best rate and size, found without flying every pair."""

from __future__ import annotations

import pytest

from hvt_study.runs.video_shape import VideoShape, competing_sizes, search_shape

RATES = (15.0, 5.0, 2.0, 1.0)
SIZES = ((640, 360), (960, 540), (1280, 720), (1920, 1080))
NOMINAL = (1280, 720)


@pytest.mark.parametrize(
    ("nominal", "source", "sizes"),
    [
        ((1280, 720), (1920, 1080), [(640, 360), (960, 540), (1280, 720), (1920, 1080)]),
        ((640, 360), (1100, 720), [(640, 360), (824, 540), (1100, 720)]),
        ((640, 360), (640, 360), [(640, 360)]),
        ((360, 240), (360, 240), [(360, 240)]),
        ((1280, 720), (360, 240), [(540, 360), (810, 540), (1280, 720)]),
        ((640, 360), (2000, 1500), [(640, 360), (720, 540), (960, 720), (1440, 1080), (2000, 1500)]),
    ],
)
def test_sizes_go_up_to_the_sources_own(nominal, source, sizes):
    """Video of the source's own size would be missing, or one that invents pixels would be flown."""
    assert list(competing_sizes(nominal, source)) == sizes


def flown(worth):
    """The shapes that are flown where a flight's worth follows from rate and size; None: refused."""
    seen = []

    def fly(shape):
        seen.append(shape)
        found = worth(shape.fps, shape.size or NOMINAL)
        return None if found is None else (found, 0.0)

    search_shape(fly, rates=RATES, sizes=SIZES, nominal=NOMINAL)
    assert len(seen) == len(set(seen))
    return seen


def test_a_larger_and_slower_one_is_found():
    """At 5 frames a second 1280x720 is best; 1920x1080 at 2 is better still."""
    seen = flown(lambda fps, size: -abs(fps - (5 if size == NOMINAL else 2)) + size[0] / 1280)
    assert VideoShape(2.0, (1920, 1080)) in seen
    assert VideoShape(5.0, (960, 540)) in seen
    assert VideoShape(1.0, (1920, 1080)) not in seen, "only neighbours of the best rate"


def test_a_way_that_gets_worse_is_left():
    """Every pair would be flown, and a study would take days."""
    seen = flown(lambda fps, size: -abs(fps - 5) - abs(size[0] - 1280))
    assert {one.size for one in seen} == {None, (960, 540), (1920, 1080)}
    assert len(seen) == len(RATES) + 2 * 3


def test_what_cannot_be_flown_is_passed_over():
    """x265 refuses large pictures at thin rates: the search must go on with the others."""
    assert flown(lambda _fps, _size: None) == [VideoShape(fps) for fps in RATES]
    seen = flown(lambda fps, size: None if size[0] > 1280 else -abs(fps - 1) - size[0])
    assert {one.size for one in seen} == {None, (640, 360), (960, 540), (1920, 1080)}
    assert {one.fps for one in seen if one.size} == {2.0, 1.0}
