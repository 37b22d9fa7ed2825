"""Bits, stills, delay and the pilot's proxies, against counts done by hand."""

import math

import pytest

from hvt_study.datasets.labels import NO_ID
from hvt_study.metrics import observed
from hvt_study.metrics.bits import line_rates, still_counts
from hvt_study.metrics.observed import Opinion, proxies, score_entropy_nats, still_delays_ms


def still(number, *, size=1000, capture_s=1.0, arrived_s=1.5):
    return observed.StillArrival(number, capture_s, capture_s + 0.1, arrived_s, size, size + 180, "due")


def named(number, track, *, share=0.01, base=None, seen=None):
    return observed.RefinedObject(number, track, 2.0, "car", "bus", share, base, seen)


def test_the_parts_add_up_to_the_whole():
    """A channel that is forgotten would give its method free bits."""
    rows = {"base": 150_000, "roi": 30_000, "tracks": 2_000, "status": 500, "backlog": 300}
    split = line_rates(rows, seconds=2.0)
    parts = {"base_bps": 600_000, "roi_bps": 120_000, "track_bps": 8_000, "other_bps": 3_200}
    assert split == {"total_bps": 8 * sum(rows.values()) / 2, **parts}
    assert line_rates({}, seconds=1.0)["total_bps"] == 0


@pytest.mark.parametrize(
    "rate",
    [lambda: line_rates({"base": 1}, seconds=math.nan), lambda: still_counts([], [], seconds=0.0)],
)
def test_no_time_to_divide_by(rate):
    """A rate of nothing by nothing must not stand in a table."""
    with pytest.raises(ValueError, match=r"divided by (nan|0\.0) s, must be above 0"):
        rate()


def test_stills_and_the_tracks_that_they_named():
    """Two stills of one track refine one track; one that matched none refines none."""
    stills = [still(1, size=800), still(2, size=1200), still(3, size=1000)]
    counts = still_counts(stills, [named(1, 7), named(2, 7), named(2, 8), named(3, NO_ID)], seconds=30.0)
    assert counts == {"stills": 3, "stills_per_min": 6.0, "mean_still_bytes": 1000.0, "tracks_refined": 2}
    nothing = still_counts([], [], seconds=30.0)
    assert (nothing["stills"], nothing["stills_per_min"], nothing["tracks_refined"]) == (0, 0.0, 0)
    assert math.isnan(nothing["mean_still_bytes"])


def test_delay_of_a_flight():
    """Stills count from the capture of their frame, as base frames do."""
    assert still_delays_ms([still(1), still(2, arrived_s=1.7)]) == (pytest.approx(600), pytest.approx(690))
    assert math.isnan(still_delays_ms([])[0])


def test_proxies():
    """They stand beside the pilot's table: gain, its sign, changes of class, entropy and the small ones alone."""
    objects = [
        named(1, 7, share=0.001, base=Opinion("car", 0.4, 1.0), seen=Opinion("bus", 0.7, 0.4)),
        named(2, 8, share=0.1, base=Opinion("car", 0.8, 0.5), seen=Opinion("car", 0.6, 0.8)),
        named(3, 9, share=0.001, base=Opinion("van", 0.5, 0.9), seen=Opinion("van", 0.5, 0.9)),
        named(4, 9, share=0.001, seen=Opinion("van", 0.9, 0.1)),
    ]
    score = proxies(objects)
    assert (score["proxy_pairs"], score["small_pairs"]) == (3, 2)
    wanted = {"confidence_base": 1.7 / 3, "confidence_refined": 1.8 / 3, "confidence_gain": 0.1 / 3}
    wanted |= {"positive_rate": 1 / 3, "change_rate": 1 / 3, "entropy_gain_nats": 0.1}
    wanted |= {"small_confidence_gain": 0.15, "small_entropy_gain_nats": 0.3}
    assert {name: score[name] for name in wanted} == pytest.approx(wanted)
    nothing = proxies([])
    assert (nothing["proxy_pairs"], nothing["small_pairs"]) == (0, 0)
    assert math.isnan(nothing["small_confidence_gain"])


@pytest.mark.parametrize(
    ("score", "classes", "nats"),
    [
        (1.0, 4, 0.0),
        (0.25, 4, math.log(4)),
        (0.0, 4, math.log(3)),
        (0.5, 2, math.log(2)),
        (0.5, 1, math.log(2) / 2),
    ],
)
def test_entropy_of_a_detectors_score(score, classes, nats):
    """Certain is 0 nats, and as likely as any other of four classes is ln 4."""
    assert score_entropy_nats(score, classes) == pytest.approx(nats)
