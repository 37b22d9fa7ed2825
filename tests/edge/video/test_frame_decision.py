"""Whether a frame is coded, as what, and where it goes: the table of the decision, row by row."""

from __future__ import annotations

from itertools import product

import pytest

from hvt_edge.backlog.stage import State
from hvt_edge.video.stage import Action, FrameDecision, FrameInputs, decide

LIVE, OFFLINE, RETURNING = State.LIVE, State.OFFLINE, State.RETURNING
SKIP, HOLD = FrameDecision(Action.SKIP), FrameDecision(Action.HOLD)
TO_LINK = FrameDecision(Action.CODE, to_link=True)
KEY_TO_LINK = FrameDecision(Action.CODE, keyframe=True, to_link=True, meets_plan=True)
RESUME = FrameDecision(Action.CODE, keyframe=True, to_link=True, meets_plan=True, resumes=True)
TO_STORE = FrameDecision(Action.CODE, to_store=True)
KEY_TO_STORE = FrameDecision(Action.CODE, keyframe=True, to_store=True, meets_plan=True)
SEGMENT = FrameDecision(Action.CODE, keyframe=True, to_store=True)
PROBE = FrameDecision(Action.CODE, to_link=True, to_store=True)
ANY = (False, True)
NO, YES = (False,), (True,)

# link, keyframe due, frame due, admitted, segment due, probe due: what is decided. ANY: it does not matter.
TABLE = [
    (LIVE, NO, NO, ANY, ANY, ANY, SKIP),
    (LIVE, NO, YES, NO, ANY, ANY, HOLD),
    (LIVE, NO, YES, YES, ANY, ANY, TO_LINK),
    (LIVE, YES, ANY, NO, ANY, ANY, HOLD),
    (LIVE, YES, ANY, YES, ANY, ANY, KEY_TO_LINK),
    (OFFLINE, NO, NO, ANY, NO, ANY, SKIP),
    (OFFLINE, NO, YES, ANY, NO, NO, TO_STORE),
    (OFFLINE, NO, YES, NO, NO, YES, TO_STORE),
    (OFFLINE, NO, YES, YES, NO, YES, PROBE),
    (OFFLINE, YES, ANY, ANY, ANY, NO, KEY_TO_STORE),
    (OFFLINE, NO, ANY, ANY, YES, NO, KEY_TO_STORE),
    (OFFLINE, YES, ANY, NO, ANY, YES, KEY_TO_STORE),
    (OFFLINE, NO, ANY, NO, YES, YES, KEY_TO_STORE),
    (OFFLINE, YES, ANY, YES, ANY, YES, FrameDecision(Action.CODE, True, True, True, True)),
    (OFFLINE, NO, ANY, YES, YES, YES, FrameDecision(Action.CODE, True, True, True, True)),
    (RETURNING, YES, ANY, YES, ANY, ANY, RESUME),
    (RETURNING, YES, NO, NO, NO, ANY, SKIP),
    (RETURNING, YES, YES, NO, NO, ANY, TO_STORE),
    (RETURNING, YES, ANY, NO, YES, ANY, SEGMENT),
    (RETURNING, NO, NO, ANY, NO, ANY, SKIP),
    (RETURNING, NO, YES, ANY, NO, ANY, TO_STORE),
    (RETURNING, NO, ANY, ANY, YES, ANY, SEGMENT),
]


@pytest.mark.parametrize("row", TABLE, ids=[str(number) for number in range(len(TABLE))])
def test_each_row_of_the_table(row):
    """A frame would be missing between what was sent and what was stored, or a ground be shown what it cannot."""
    link, keyframe_due, due, admitted, segment_due, probe_due, expected = row
    for one in product(due, keyframe_due, admitted, segment_due, probe_due):
        inputs = FrameInputs(*one[:3], link=link, segment_due=one[3], probe_due=one[4])
        assert decide(inputs) == expected, inputs


def test_the_table_leaves_no_case_out_and_decides_none_twice():
    """One combination in flight that nobody thought of would be decided by accident."""
    seen = [
        (link, *one)
        for link, keyframe_due, due, admitted, segment_due, probe_due, _ in TABLE
        for one in product(keyframe_due, due, admitted, segment_due, probe_due)
    ]
    assert len(seen) == len(set(seen)) == 3 * 2**5


def test_rates_change_at_keyframes_for_the_link_alone():
    """What is stored would change its quality, or the stream on the link its parameters in mid-GOP."""
    assert [one.reconfigures for one in (TO_LINK, KEY_TO_LINK, RESUME, TO_STORE, KEY_TO_STORE, SEGMENT)] == [
        False, True, True, False, False, False,
    ]  # fmt: skip
    assert [one.codes for one in (SKIP, HOLD, TO_LINK, SEGMENT)] == [False, False, True, True]
