"""Where stills lie in the gallery, those of now and those of an outage that come late."""

from __future__ import annotations

from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from hvt_ground.sinks.rerun.gallery import Gallery


class Replay:
    """What a viewer shows of the gallery: the latest row of each before a moment."""

    def __init__(self, slots: int) -> None:
        self.slots = slots
        self.pictures: dict[tuple[int, int], str] = {}
        self.captions: dict[int, tuple[str, ...]] = {}

    def write(self, slot: int, frame: int, name: str, rows) -> None:
        """Log a pair."""
        self.pictures[slot, frame] = name
        for row in rows:
            self.captions[row.frame_index] = row.captions

    def agrees(self, frame: int) -> bool:
        """Whether each picture stands over its own words."""
        known = [at for at in self.captions if at <= frame]
        captions = self.captions[max(known)] if known else ("",) * self.slots
        for slot in range(self.slots):
            shown = [at for of, at in self.pictures if of == slot and at <= frame]
            if captions[slot] != (self.pictures[slot, max(shown)] if shown else ""):
                return False
        return True


@given(events=st.lists(st.tuples(st.booleans(), st.integers(0, 60), st.booleans()), max_size=30))
@hypothesis_settings(max_examples=300, deadline=None)
def test_pictures_and_captions_agree_at_every_moment(events):
    """The gallery would show a lorry under the words of a bus."""
    gallery, replay = Gallery(("",) * 3, hold_ns=2), Replay(3)
    newest, taken = 0, set()
    for live, number, changed in events:
        # Stills of now come in their order, those of the past at any time between them.
        frame = newest + 1 + number % 5 if live else number
        if frame in taken or (not live and frame > newest):
            continue
        name = f"{'live' if live else 'late'} {frame}"
        if live:
            newest, put = frame, gallery.put(frame, frame, name, changed=changed)
        else:
            put = gallery.put_stored(frame, frame, name)
        if put is not None:
            taken.add(frame)
            replay.write(put.slot, frame, name, put.rows)
    assert all(replay.agrees(frame) for frame in range(newest + 2))


def test_an_old_still_holds_its_slot_for_a_while_only_where_one_is_free():
    """Pairs would flicker by, or an old one would push out what is shown now."""
    gallery = Gallery(("", ""), hold_ns=10)
    assert gallery.put(0, 0, "a", changed=False).slot == 0
    assert gallery.put(1, 0, "a", changed=False).slot == 1
    assert gallery.put(100, 100, "b", changed=False).slot == 0
    assert gallery.put_stored(50, 50, "x").slot == 0
    assert gallery.put_stored(55, 55, "y").slot == 1
    assert gallery.put_stored(57, 57, "z") is None
    assert gallery.put_stored(95, 95, "z").slot == 1
