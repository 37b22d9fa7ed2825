"""How steadily an object is held, against counts done by hand."""

from __future__ import annotations

import math

from hvt_study.metrics.judged import judged
from hvt_study.metrics.tracking import continuity
from studies.metric_frames import labels, square, view


def flight(life):
    """One labelled car, found where the text has a plus; a stray box is at every frame."""
    found, stray = (square(1), "truck", 7, 0.9), (square(300), "car", 8, 0.9)
    truth = labels((square(0), "car", 1))
    return [(truth, view(found, stray) if sign == "+" else view(stray)) for sign in life]


def test_gaps_begin_after_the_first_find_and_no_stray_box_counts():
    """A target that is lost again and again would look as good as one that is held, or one that is found late."""
    one = continuity(judged(flight("--+++-++---+-")))
    assert (one.objects, one.gaps, one.longest_gap) == (1, 3, 3)
    assert one.found_share == 6 / 13


def test_what_is_never_found_has_no_gaps():
    """Else who never finds it would hold it best."""
    one = continuity(judged(flight("---")))
    assert (one.found_share, one.gaps, one.longest_gap) == (0.0, 0, 0)


def test_labels_without_ids_say_nothing():
    """Reference labels do not know which object is which."""
    one = continuity(judged([(labels((square(0), "car")), view((square(0), "car")))]))
    assert one.objects == 0
    assert math.isnan(one.found_share)
