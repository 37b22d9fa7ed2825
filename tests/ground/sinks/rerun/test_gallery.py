"""Where stills lie in the gallery, those of now and those of an outage that come late."""

from __future__ import annotations

from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from hvt_ground.sinks.rerun.still_places import Gallery


@given(events=st.lists(st.tuples(st.booleans(), st.integers(0, 60)), max_size=60))
@hypothesis_settings(max_examples=300, deadline=None)
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
    assert gallery.put(0, 0, changed=False) == 0
    assert gallery.put(1, 0, changed=False) == 1
    assert gallery.put(100, 100, changed=False) == 0
    assert gallery.put_stored(50, 50) == 0
    assert gallery.put_stored(55, 55) == 1
    assert gallery.put_stored(57, 57) is None
    assert gallery.put_stored(95, 95) == 1


def test_what_is_too_long_ago_to_tell_finds_no_slot():
    """Memory would grow with every still of a flight of weeks."""
    gallery = Gallery(1, hold_ns=10)
    for frame in range(0, 6000, 10):
        assert gallery.put(frame, frame, changed=False) == 0
    assert gallery.put_stored(5, 5) is None
    assert gallery.put(7000, 7000, changed=False) == 0
    assert gallery.put_stored(6500, 6500) == 0
