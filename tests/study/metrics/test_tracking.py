"""MOTA, IDF1 and HOTA, against published figures and counts done by hand."""

import math
import tracemalloc

import motmetrics
import numpy as np
import pytest

from hvt_common.values import iou
from hvt_study.metrics.judged import FrameView, judged
from hvt_study.metrics.tracking import ALPHAS, compare_tracks, continuity, tracking_score
from studies.metric_frames import labels, square, view

SEQUENCES = ("TUD-Campus", "TUD-Stadtmitte")


def tud(data, sequence):
    """The frames of one sequence, true and found."""
    sides = []
    for name in ("gt.txt", "test.txt"):
        rows = np.loadtxt(data / "tracking/motmetrics_tud" / sequence / name, delimiter=",")
        rows = rows[rows[:, 6] == 1] if name == "gt.txt" else rows
        rows[:, 4:6] += rows[:, 2:4]
        sides.append(rows)
    frames = sorted({*sides[0][:, 0], *sides[1][:, 0]})
    return [
        tuple((rows[rows[:, 0] == k, 1].astype(int), rows[rows[:, 0] == k, 2:6]) for rows in sides)
        for k in frames
    ]


@pytest.mark.realdata
def test_published_figures(data):
    """MOTA and IDF1 would not be what the literature means by them (percent, as motmetrics publishes them)."""
    scores = [compare_tracks(tud(data, name)) for name in SEQUENCES]
    figures = [(round(100 * one.mota, 1), round(100 * one.idf1, 1), one.switches) for one in scores]
    assert figures == [(52.6, 55.8, 7), (56.4, 64.5, 7)]
    # TrackEval 1.3.0, of HOTA's authors, gives these for the same files.
    hota = [one.hota for one in scores]
    np.testing.assert_allclose(hota, [0.39139743784511377, 0.3978490169927877], rtol=1e-12)


@pytest.mark.parametrize("seed", range(8))
def test_identities_are_those_of_motmetrics(seed):
    """Objects that change their ids at random, two at one place and some that are not there."""
    drawn = np.random.default_rng(seed)
    events, frames = motmetrics.MOTAccumulator(), []
    for number in range(30):
        true, shown = (drawn.permutation(9)[: drawn.integers(1, 9)] for _ in range(2))
        places = [
            np.array([square(4 * place) for place in drawn.integers(0, 12, len(ids))])
            for ids in (true, shown)
        ]
        frames.append(((true, places[0]), (shown, places[1])))
        distance = 1 - iou(*places)
        events.update(true, shown, np.where(distance > 0.5, np.nan, distance), frameid=number)
    names = ["idtp", "idfp", "idfn"]
    theirs = motmetrics.metrics.create().compute(events, metrics=names, return_dataframe=False)
    ours = compare_tracks(frames)
    figures = (ours.id_true_positives, ours.id_false_positives, ours.id_false_negatives)
    assert figures == tuple(theirs[name] for name in names)


def test_a_study_of_many_tracks_is_scored_in_little_memory():
    """10,000 tracks took 4 GB in matrices of all tracks, true and shown, by all of them."""
    there, beside = (np.array([square(200 * k + off) for k in range(10)]) for off in (0, 50))
    ids = np.arange(1500).reshape(150, 10)
    frames = [((ten, there), (ten, (there, beside)[k % 2])) for k, ten in enumerate(ids)]
    tracemalloc.start()
    try:
        assert compare_tracks(frames).id_true_positives == 750
        assert tracemalloc.get_traced_memory()[1] < 10e6
    finally:
        tracemalloc.stop()


def test_hota_by_hand():
    """One track of four frames, found under two ids for two frames each, boxes exact."""
    there = np.array([1]), np.array([square(0)])
    frames = [(there, (np.array([10 + k // 2]), np.array([square(0)]))) for k in range(4)]
    score = compare_tracks(frames)
    # DetA is 1. Each hit c: TPA 2, FNA 2, FPA 0, so A(c) is 1/2.
    assert score.hota == pytest.approx(math.sqrt(0.5))
    assert (score.switches, score.mota) == (1, 0.75)
    assert score.idf1 == pytest.approx(2 * 2 / (4 + 4))


def test_hota_judges_how_well_boxes_fit():
    """IoU 0.62: found at the alphas up to 0.6, that is 12 of 19."""
    frames = [((np.array([1]), np.array([(0, 0, 100, 10)])), (np.array([1]), np.array([(0, 0, 62, 10)])))]
    score = compare_tracks(frames * 3)
    assert len(ALPHAS) == 19
    assert score.hota == pytest.approx(12 / 19)
    assert score.mota == 1.0


def two_that_cross(ids):
    """Two labelled cars for six frames; ``ids`` names the boxes on each, or None where one is not shown."""
    frames = []
    for pair in ids:
        there = [(square(100 * k), "car", k) for k in range(2)]
        shown = [(square(100 * k), "car", name) for k, name in enumerate(pair) if name is not None]
        frames.append((labels(*there), view(*shown)))
    return frames


def test_switches_misses_and_false_positives():
    """Counts done by hand; a wrong one would move every tracking figure of the report."""
    ids = [(5, 6), (5, 6), (6, 5), (6, None), (6, 5), (6, 5)]
    score = tracking_score(judged(two_that_cross(ids)))
    assert (score.objects, score.misses, score.false_positives, score.switches) == (12, 1, 0, 2)
    assert score.mota == pytest.approx(1 - 3 / 12)
    # Best assignment: 0 with 6 (4 frames), 1 with 5 (3 frames).
    assert (score.id_true_positives, score.idf1) == (7, pytest.approx(14 / (12 + 11)))


def test_ignored_regions_and_plain_detections():
    """What lies in an ignored region, and what belongs to no track, is nobody's false alarm."""
    truth = labels((square(0), "car", 1), (square(300), "car"), ignored=[(90, 0, 200, 50)])
    shown = view((square(0), "car", 4), (square(100), "car", 5), (square(500), "car", -1))
    score = tracking_score(judged([(truth, shown)] * 3))
    assert (score.objects, score.misses, score.false_positives) == (3, 0, 0)
    assert (score.mota, score.idf1, score.hota) == (1.0, 1.0, 1.0)


def test_nothing():
    """Reference labels know no tracks: no figure is better than a wrong one."""
    for frames in ([], [(labels((square(0), "car")), FrameView())], [(labels(), view())]):
        score = tracking_score(judged(frames))
        assert all(math.isnan(each) for each in (score.mota, score.idf1, score.hota))
    ghosts = tracking_score(judged([(labels(), view((square(0), "car", 1)))]))
    assert (ghosts.false_positives, math.isnan(ghosts.mota)) == (1, True)
    blind = tracking_score(judged([(labels((square(0), "car", 1)), FrameView())] * 2))
    assert (blind.mota, blind.idf1, blind.hota) == (0.0, 0.0, 0.0)


# How steadily an object is held, against counts done by hand.


def flight(life):
    """One labelled car, found where the text has a plus; a stray box is at every frame."""
    found, stray = (square(1), "truck", 7, 0.9), (square(300), "car", 8, 0.9)
    truth = labels((square(0), "car", 1))
    return [(truth, view(found, stray) if sign == "+" else view(stray)) for sign in life]


def test_gaps_begin_after_the_first_find_and_no_stray_box_counts():
    """A target that is lost again and again would look as good as one that is held, or one that is found late."""
    one = continuity(judged(flight("--+++-++---+-")))
    assert (one.gaps, one.longest_gap) == (3, 3)
    assert one.found_share == 6 / 13


def test_what_is_never_found_has_no_gaps():
    """Neither some nor 0, or who never finds it would hold it best."""
    for life, gaps in (("---", None), ("--+", 0)):
        one = continuity(judged(flight(life)))
        assert (one.gaps, one.longest_gap) == (gaps, gaps)
        assert one.found_share == life.count("+") / 3


def test_labels_without_ids_say_nothing():
    """Reference labels do not know which object is which."""
    one = continuity(judged([(labels((square(0), "car")), view((square(0), "car")))]))
    assert one.gaps is None
    assert math.isnan(one.found_share)
