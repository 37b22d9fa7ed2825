"""Neighbours that share a still: never more bytes, nobody lost, the same every time."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.protocol.ledger import overhead_bytes
from hvt_common.protocol.messages import AlsoShown
from hvt_common.video.base_crop import coded_size
from hvt_edge.perception.candidates import crop_box
from hvt_edge.stills.policy.base import (
    ALSO_BYTES,
    MOST_ALSO,
    STILL_OVERHEAD_BYTES,
    CostEstimate,
    Request,
    expected_bytes,
    group,
    union_crop,
)
from rigs.examples import candidate
from rigs.messages import ROI

SOURCE = (1280, 720)
PADDING = 0.15
COSTS = st.builds(CostEstimate, st.floats(0, 800), st.floats(0, 0.3), st.just(1000.0))  # fixed, a pixel, mean


def request_for(track_id: int, x: float, y: float, *, side: float = 20, score: float = 1.0) -> Request:
    box = (x, y, x + side, y + side)
    size = coded_size(crop_box(box, padding=PADDING, source_size=SOURCE))
    one = candidate(track_id, box, frame_index=7, confidence=0.5, crop_area_px=float(size[0] * size[1]))
    return Request(one, "gain", score)


@st.composite
def requests_of(draw) -> list[Request]:
    places = draw(
        st.lists(
            st.tuples(st.floats(0, 1200), st.floats(0, 640), st.floats(2, 700), st.floats(0, 9)), max_size=30
        )
    )
    some = [
        request_for(number + 1, x, y, side=min(side, 1280 - x, 720 - y), score=score)
        for number, (x, y, side, score) in enumerate(places)
    ]
    return sorted(some, key=lambda one: (-one.score, one.candidate.track_id))


def joined(some: list[Request], **changes) -> list[Request]:
    plain = {"cost": CostEstimate(300, 0.1, 1000), "overhead_bytes": STILL_OVERHEAD_BYTES}
    return group(some, **{**plain, **changes}, padding=PADDING, source_size=SOURCE)


def line_bytes(one: Request, cost: CostEstimate, overhead: float) -> float:
    payload = expected_bytes(one, cost=cost, padding=PADDING, source_size=SOURCE)
    return payload + overhead + ALSO_BYTES * len(one.also)


@given(some=requests_of(), cost=COSTS, overhead=st.floats(0, 300))
def test_sharing_never_costs_more_and_loses_nobody(some, cost, overhead):
    """Sharing would waste what it is there to save, or an object would never get its still."""
    groups = joined(some, cost=cost, overhead_bytes=overhead)
    assert joined(some, cost=cost, overhead_bytes=overhead) == groups
    tracks = [(lead.candidate.track_id, *(one.track_id for one in lead.also)) for lead in groups]
    assert sorted(one for shown in tracks for one in shown) == sorted(one.candidate.track_id for one in some)
    by_id = {one.candidate.track_id: one for one in some}
    for lead, shown in zip(groups, tracks, strict=True):
        alone = [by_id[one] for one in shown]
        singly = sum(line_bytes(one, cost, overhead) for one in alone)
        assert line_bytes(lead, cost, overhead) <= singly + 1e-6
        assert shown[1:] == tuple(sorted(shown[1:]))
        assert len(lead.also) <= MOST_ALSO
        assert lead.score >= max(one.score for one in alone)
        if lead.also:
            x1, y1, x2, y2 = union_crop(lead, padding=PADDING, source_size=SOURCE)
            assert max(x2 - x1, y2 - y1) <= 512
        else:
            assert lead == alone[0]
    scores = [lead.score for lead in groups]
    assert scores == sorted(scores, reverse=True)


def test_a_car_park_row_shares_and_the_far_one_does_not():
    """Four headers would be paid for four objects that one small crop shows."""
    row = [request_for(number, 100 + 24 * number, 200, score=5 - number) for number in range(1, 5)]
    far, cost = request_for(9, 900, 600, score=0.5), CostEstimate(300, 0.1, 1000)
    first, second = joined([*row, far])
    assert first.candidate.track_id == 1
    assert [one.track_id for one in first.also] == [2, 3, 4]
    assert union_crop(first, padding=PADDING, source_size=SOURCE) == (121, 197, 219, 223)
    assert second == far
    single = sum(one.score * line_bytes(one, cost, STILL_OVERHEAD_BYTES) for one in row)
    assert first.score == pytest.approx(single / (300 + 0.1 * 98 * 26 + STILL_OVERHEAD_BYTES + 3 * 17))
    many = [request_for(number, 100 + 9 * number, 200, side=8) for number in range(1, 31)]
    assert max(len(one.also) for one in joined(many, cost=CostEstimate(300, 0, 1000))) == MOST_ALSO


@pytest.mark.parametrize(("apart", "cost_per_px", "stills"), [(100, 0.01, 1), (100, 0.3, 2), (600, 0.0, 2)])
def test_pixels_between_have_their_price(apart, cost_per_px, stills):
    """Two objects at the two ends of the picture would make one huge still."""
    pair = [request_for(1, 100, 200), request_for(2, 100 + apart, 200)]
    assert len(joined(pair, cost=CostEstimate(300, cost_per_px, 1000))) == stills
    assert joined([]) == []


def test_the_overhead_that_is_reckoned_with_is_the_real_one():
    """Stills would be joined, or ranked, by a cost that no message has."""

    def header(also: int) -> int:
        box = (1200.125, 600.5, 1300.375, 650.25)
        objects = tuple(AlsoShown(track_id=400 + number, box_source_px=box) for number in range(also))
        one = replace(ROI, session_id=2**63, box_source_px=box, reason="gain", parameters={}, also=objects)
        return len(one.pack(b"x" * 1000))

    framing = overhead_bytes(1000, header(0), key=EdgeKeys("edge-1")[Channel.ROI], encoding="image/jpeg")
    assert header(0) + framing == pytest.approx(STILL_OVERHEAD_BYTES, abs=15)
    assert (header(8) - header(0)) / 8 == pytest.approx(ALSO_BYTES, abs=1)


def test_a_crowd_takes_bounded_time():
    """A thousand tracks would stop the pictures."""
    places = np.random.default_rng(3).uniform((0, 0), (1200, 640), (1000, 2)).tolist()
    crowd = [request_for(number, x, y, side=8) for number, (x, y) in enumerate(places, 1)]
    assert sum(1 + len(lead.also) for lead in joined(crowd)) == 1000
