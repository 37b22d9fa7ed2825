"""Classes of tracks over time, and how long the right one takes, against counts done by hand."""

import math

import pytest

from hvt_common.inference.class_names import kind_of
from hvt_study.metrics.classes import ClassCounts, class_score, first_correct
from hvt_study.metrics.judged import FrameView, judged
from studies.metric_frames import labels, square, view


def frame_of_four():
    """A car and a bus that a still mended are right, a truck is called car, a van missed; a bus is on nothing."""
    truth = labels(
        (square(0), "car"), (square(100, side=50), "bus"), (square(200), "truck"), (square(300), "van")
    )
    shown = view(
        (square(1), "car", 1, 0.9),
        (square(100, side=50), "bus", 2, 0.9, "car"),
        (square(200), "car", 3, 0.9),
        (square(700), "bus", 4, 0.9),
    )
    return truth, shown


def test_after_refinement():
    """These figures are the study's answer; both kinds of share must be what they are called."""
    score = class_score(judged([frame_of_four()]))
    assert score.counts == ClassCounts(right=2, found=3, labels=4)
    assert score.counts.top1_found == pytest.approx(2 / 3)
    assert score.counts.top1_all == 0.5
    assert (score.recall, score.precision, score.f1) == (0.75, 0.75, 0.75)
    # Two of four boxes are right, two of four labels missed or misnamed; two boxes of one frame are false.
    assert (score.named_f1, score.false_per_frame) == (0.5, 2.0)
    # Of all: car 2·1/(1+2), bus 2·1/(1+2) with the one on nothing, truck 0, van 0.
    assert score.macro_f1_all == pytest.approx((2 / 3 + 2 / 3) / 4)
    # Of those found: car 2·1/(1+2), bus 1, truck 0.
    assert score.macro_f1_found == pytest.approx((2 / 3 + 1) / 3)
    # Without what is before it, the stills' gain could not be told from the detector's skill.
    before = class_score(judged([frame_of_four()]), refined=False)
    assert before.counts == ClassCounts(right=1, found=3, labels=4)
    assert before.macro_f1_found == pytest.approx(0.5 / 3)  # car 2·1/(1+3), the others 0


def test_listing_more_wins_nothing():
    """A method that lists three boxes for each vehicle shows as many with their class as one that lists one."""
    truth = labels((square(0), "car"), (square(200), "bus"))
    one = view((square(0), "car", 1, 0.9), (square(200), "bus", 2, 0.9))
    more = ((square(at), name, 9 + at, 0.9) for at, name in ((3, "car"), (203, "car"), (400, "bus")))
    three = view((square(0), "car", 1, 0.9), (square(200), "bus", 2, 0.9), *more)
    few, many = class_score(judged([(truth, one)] * 2)), class_score(judged([(truth, three)] * 2))
    assert few.counts.top1_all == many.counts.top1_all == 1.0
    assert (few.named_f1, few.false_per_frame) == (1.0, 0.0)
    assert (many.named_f1, many.false_per_frame) == (pytest.approx(4 / 7), 3.0)


def test_every_frame_counts_not_only_the_refined_one():
    """A still that mends a class late must gain less than one that mends it early."""
    truth = labels((square(0), "bus"))
    wrong, right = view((square(0), "car", 1)), view((square(0), "bus", 1, 0.9, "car"))
    late = class_score(judged([(truth, wrong)] * 8 + [(truth, right)] * 2))
    early = class_score(judged([(truth, wrong)] * 2 + [(truth, right)] * 8))
    assert (late.counts.top1_all, early.counts.top1_all) == (0.2, 0.8)


def test_sizes_and_ignored_regions():
    """Small objects are what stills are for; unlabelled crowds are nobody's fault."""
    score = class_score(judged([frame_of_four()]))
    assert score.by_size["small"] == ClassCounts(right=1, found=2, labels=3)
    assert score.by_size["medium"] == ClassCounts(right=1, found=1, labels=1)
    assert math.isnan(score.by_size["large"].top1_all)
    truth = labels((square(0), "car"), ignored=[(90, 0, 200, 50)])
    shown = view((square(0), "car"), (square(100), "bus"))
    assert class_score(judged([(truth, shown)])).boxes == 1


def test_a_refinement_cannot_take_a_false_box_out_of_the_account():
    """A classifier that calls all strays 'bench' would look precise otherwise."""
    truth = labels((square(0), "car"))
    shown = view((square(0), "car"), (square(50), "bench", 1, 0.5, "car"), (square(80), "bench"))
    score = class_score(judged([(truth, shown)], classes={"car"}))
    assert (score.boxes, score.precision) == (2, 0.5)


def test_what_merely_moves_is_found_and_has_no_class():
    """The motion detector knows no classes: it must be credited with boxes and nothing more."""
    frame_index = labels((square(0), "van")), view((square(0), "moving", 1))
    score = class_score(judged([frame_index], word=kind_of, classes={"car"}))
    assert score.counts == ClassCounts(right=0, found=1, labels=1)


def test_nothing():
    """Empty sequences, blind grounds and empty roads are answers, not crashes; unknown figures are no 1 and no 0."""
    empty = class_score(judged([]))
    assert empty.counts == ClassCounts()
    assert all(map(math.isnan, (empty.macro_f1_all, empty.f1, empty.named_f1, empty.precision)))
    blind = class_score(judged([(labels((square(0), "car")), FrameView())]))
    assert (blind.counts.top1_all, blind.macro_f1_all, blind.recall, blind.f1) == (0.0, 0.0, 0.0, 0.0)
    assert math.isnan(blind.counts.top1_found)
    assert math.isnan(blind.macro_f1_found)
    ghosts = class_score(judged([(labels(), view((square(0), "car")))]))
    assert (ghosts.precision, ghosts.false_per_frame) == (0.0, 1.0)
    assert all(map(math.isnan, (ghosts.recall, ghosts.f1, ghosts.named_f1)))


def sequence(*lives):
    """Five frames; each life is the class that a bus is shown with at every frame: b, c, - for missed."""
    word = {"b": "bus", "c": "car"}
    frames = []
    for frame_index in range(5):
        there = [
            (square(100 * track), "bus", track) for track, life in enumerate(lives) if frame_index < len(life)
        ]
        shown = [
            (square(100 * track), word[life[frame_index]], 50 + track)
            for track, life in enumerate(lives)
            if frame_index < len(life) and life[frame_index] != "-"
        ]
        frames.append((labels(*there), view(*shown)))
    return frames


def test_time_to_the_first_right_class():
    """How long an operator looks at a wrong word; tracks that never come right must not be forgotten."""
    frames = judged(sequence("bbbbb", "-ccbb", "ccccc"))
    waits = first_correct(frames, fps=10)
    assert waits.waits_s.tolist() == [0.0, 0.3, 0.4]
    assert (waits.tracks, waits.never) == (3, 1)
    # Kaplan-Meier: 2/3 still wait after 0 s, 1/3 after 0.3 s, and no one knows more.
    assert (waits.median_s, waits.p90_s, waits.quantile_s(1 / 3)) == (pytest.approx(0.3), math.inf, 0.0)
    # A method that answers two seconds late is not as quick as one that answers at once.
    late = first_correct(frames, fps=10, shown_s=[2.0, 2.1, 2.2, 2.3, 2.5])
    assert late.waits_s.tolist() == pytest.approx([2.0, 2.3, 2.5])
    assert late.never == 1


def test_a_track_that_leaves_early_is_no_proof_of_a_long_wait():
    """Censored at 0.1 s: the median is that of the others, who were watched for longer."""
    waits = first_correct(judged(sequence("cc", "ccb", "cccb", "ccccb")), fps=10)
    assert waits.never == 1
    # At risk after 0.1 s are three; after 0.3 s a third of them waits.
    assert waits.median_s == pytest.approx(0.3)
    assert waits.p90_s == pytest.approx(0.4)


def test_before_refinement_and_without_tracks():
    """Reference labels know no tracks: no figure is better than a wrong one."""
    mended = [(labels((square(0), "bus", 7)), view((square(0), "bus", 1, 0.9, "car")))] * 3
    assert first_correct(judged(mended), fps=15).median_s == 0.0
    nobody = first_correct(judged([(labels((square(0), "bus")), view((square(0), "bus")))]), fps=15)
    assert nobody.tracks == 0
    assert math.isnan(nobody.median_s)
    assert first_correct(judged([]), fps=15).tracks == 0
