"""What the ground sees on real decoded pictures, and what stills change."""

from __future__ import annotations

import numpy as np
import pytest

from flight import CLASSES, Flight, RedSquares, SameAnswer, sight_of, square_box
from hvt_common.link.wire import RoiHeader
from hvt_common.values import Posterior
from hvt_common.vision.hevc import BaseDecoder
from hvt_ground.events import Notice, Overlay, Refinement
from hvt_ground.sight import GroundSight, Picture, ReceivedStill


@pytest.fixture(scope="module")
def flight() -> Flight:
    """Two seconds."""
    return Flight(30)


@pytest.fixture(scope="module")
def pictures(flight) -> list[Picture]:
    """As the decoder gives them."""
    decoder = BaseDecoder()
    return [
        Picture(unit.frame_index, unit.capture_ns, unit.capture_ns, decoder.decode(unit.data))
        for unit in flight.units
    ]


class Rig:
    """Eyes, and all that they emitted."""

    def __init__(self, **options) -> None:
        self.events: list = []
        self.reader = options.pop("reader", SameAnswer())
        self.sight: GroundSight = sight_of(self.events.append, reader=self.reader, **options)

    def of(self, kind) -> list:
        """Events of a kind."""
        return [one for one in self.events if isinstance(one, kind)]


def received(flight: Flight, index: int, sequence: int, **changes) -> ReceivedStill:
    """A still with its header parsed."""
    item = flight.still(index, sequence, **changes)
    return ReceivedStill(RoiHeader.parse(item.attachment, item.payload), item.payload, item.encoding)


def test_each_frame_gives_an_overlay_with_the_track_where_the_object_is(pictures):
    """Boxes would lag behind the picture or be missing from some frames."""
    rig = Rig(detect_every=3)
    for picture in pictures:
        rig.sight.see(picture, hurry=False)
    overlays = rig.of(Overlay)
    assert [one.frame_index for one in overlays] == list(range(30))
    assert rig.sight.detections_run == 10
    assert rig.sight.tracks == 1
    for one in overlays[6:]:
        assert one.track_ids.tolist() == [1]
        np.testing.assert_allclose(one.boxes_base_px[0], square_box(one.frame_index), atol=6)
        assert (one.classes, one.refined.tolist()) == (("car",), [False])


def test_in_a_hurry_detection_waits_but_the_track_goes_on(pictures):
    """Boxes would vanish whenever the machine is busy."""
    rig = Rig()
    for picture in pictures:
        rig.sight.see(picture, hurry=picture.frame_index % 4 != 0)
    assert rig.sight.detections_run == 8
    assert all(len(one.track_ids) == 1 for one in rig.of(Overlay)[8:])


def test_a_still_changes_the_class_of_the_track_at_its_frame(flight, pictures):
    """The whole point: the sharp still says bus, and the track would go on being called car."""
    rig = Rig()
    for picture in pictures[:12]:
        rig.sight.see(picture, hurry=False)
    rig.sight.read([received(flight, 8, 0)])
    rig.sight.see(pictures[12], hurry=False)
    (refinement,) = rig.of(Refinement)
    assert (refinement.track_id, refinement.class_before, refinement.class_after) == (1, "car", "bus")
    assert (refinement.still_sequence, refinement.edge_track_id, refinement.frame_index) == (0, 1, 11)
    assert refinement.base_crop_bgr.shape == (32, 32, 3)
    assert refinement.base_crop_bgr[16, 16, 2] > 150, "the base crop shows the square of frame 8"
    last = rig.of(Overlay)[-1]
    assert (last.base_classes, last.classes, last.refined.tolist()) == (("car",), ("bus",), [True])
    assert (rig.sight.refined, rig.sight.class_changes, dict(rig.sight.outcomes)) == (1, 1, {"matched": 1})


def test_the_edge_hears_of_every_still_once(flight, pictures):
    """A lockstep edge would wait in vain; M3 would count an answer twice."""
    rig = Rig()
    for picture in pictures[:10]:
        rig.sight.see(picture, hurry=False)
    rig.sight.read([received(flight, 8, 0), received(flight, 9, 1, data=b"broken"), received(flight, 9, 2)])
    results = rig.sight.take_results()
    # Those of one frame are read together; one that cannot be decoded is answered as no opinion.
    assert sorted((one.still_sequence, one.class_name) for one in results) == [
        (0, "bus"),
        (1, ""),
        (2, "bus"),
    ]
    (track_id,) = rig.of(Overlay)[-1].track_ids.tolist()
    assert {one.still_sequence: one.ground_track_id for one in results} == {0: track_id, 1: -1, 2: track_id}
    assert rig.sight.take_results() == []
    assert dict(rig.sight.stills_dropped) == {"undecodable": 1}
    assert [one.level for one in rig.of(Notice)] == ["warning"]


@pytest.mark.parametrize(
    "changes",
    [
        {"codec": "webp2"},
        {"crop_source_px": (0, 0, 8, 8)},  # the picture inside is larger than it says
        {"crop_source_px": (0, 0, 30_000, 30_000)},  # beyond the source: it could hide any number of pixels
    ],
)
def test_a_still_that_lies_about_itself_is_dropped(flight, pictures, changes):
    """One message could make the ground reserve gigabytes, or end it."""
    rig = Rig()
    rig.sight.see(pictures[0], hurry=False)
    rig.sight.read([received(flight, 0, 0, **changes)])
    assert dict(rig.sight.stills_dropped) == {"undecodable": 1}


def test_a_name_of_any_language_and_length_goes_back_to_the_edge(flight, pictures):
    """A classifier with names in Chinese would end the ground at its first still."""

    class Wordy(SameAnswer):
        def read(self, stills, base_bgr):
            return [Posterior("乗用車\n" * 30, 1.0, 0.0, np.array([0.0, 1.0], np.float32))] * len(stills)

    rig = Rig(reader=Wordy())
    rig.sight.see(pictures[0], hurry=False)
    rig.sight.read([received(flight, 0, 0)])
    (result,) = rig.sight.take_results()
    assert len(result.class_name.encode()) <= 64
    assert result.class_name.startswith("乗用車?乗用車")


def test_a_still_that_nobody_can_read_is_shown_all_the_same(flight, pictures):
    """Without a classifier the operator would not even see the sharp picture."""
    rig = Rig(reader=SameAnswer(knows=False))
    for picture in pictures[:6]:
        rig.sight.see(picture, hurry=False)
    rig.sight.read([received(flight, 4, 0)])
    (refinement,) = rig.of(Refinement)
    assert (refinement.track_id, refinement.class_before, refinement.class_after) == (None, "car", "car")
    assert refinement.still[:2] == b"\xff\xd8"
    assert (rig.sight.refined, dict(rig.sight.outcomes)) == (0, {"unread": 1})


def test_what_still_waits_at_the_end_is_given_out(flight, pictures):
    """The last stills of a flight would be missing from its recording."""
    rig = Rig()
    for picture in pictures[:3]:
        rig.sight.see(picture, hurry=False)
    rig.sight.read([received(flight, 9, 0)])  # its frame will not come
    assert rig.of(Refinement) == []
    rig.sight.end()
    (refinement,) = rig.of(Refinement)
    assert refinement.track_id is None
    assert sum(rig.sight.outcomes.values()) == 1


def test_a_picture_without_objects_is_an_empty_overlay(flight):
    """An empty scene would crash the eyes, or show boxes of the past for ever."""
    grey = np.full((192, 320, 3), 120, np.uint8)
    rig = Rig(detector=RedSquares())
    rig.sight.see(Picture(0, 0, 0, grey), hurry=False)
    (overlay,) = rig.of(Overlay)
    assert overlay.boxes_base_px.shape == (0, 4)
    assert (overlay.classes, rig.sight.tracks) == ((), 0)
    assert flight.info().class_names == CLASSES
