"""What the ground sees on real decoded pictures, and what stills change."""

import threading
from dataclasses import replace

import cv2
import numpy as np
import pytest

from hvt_common.inference.scale_search import ScaleSearch
from hvt_common.inference.view_trust import ViewTrust
from hvt_common.protocol.messages import AlsoShown, RoiHeader
from hvt_common.values import Detections, View
from hvt_common.video.base_crop import base_crop
from hvt_common.video.hevc import BaseDecoder, YuvPicture
from hvt_common.video.still_codecs import still_codec
from hvt_ground.events import Notice, Overlay, Refinement
from hvt_ground.perception import guesses
from hvt_ground.perception.guesses import Guesses
from hvt_ground.perception.history import as_bgr
from hvt_ground.perception.models import DetectorThread
from hvt_ground.perception.pipeline import DecodedFrame, Pipeline, ReceivedStill
from hvt_ground.perception.stills.refine import ViewTilt
from hvt_ground.perception.worker import RealtimeWorker
from programs.processes import eventually
from rigs.flight import (
    CLASSES,
    Flight,
    NothingSeen,
    RedSquares,
    SameAnswer,
    pipeline_of,
    square_box,
    tracks_at,
)


@pytest.fixture(scope="module")
def flight() -> Flight:
    """Two seconds."""
    return Flight(30)


@pytest.fixture(scope="module")
def pictures(flight) -> list[DecodedFrame]:
    decoder = BaseDecoder()
    return [
        DecodedFrame(unit.frame_index, unit.capture_ns, unit.capture_ns, decoder.decode(unit.data))
        for unit in flight.units
    ]


class Rig:
    """Perception, and all that they emitted."""

    def __init__(self, **options) -> None:
        self.events: list = []
        self.reader = options.pop("reader", SameAnswer())
        self.pipeline: Pipeline = pipeline_of(self.events.append, reader=self.reader, **options)

    def look(self, pictures):
        for picture in pictures:
            self.pipeline.analyze(picture, hurry=False)
        return self

    def of(self, kind) -> list:
        return [one for one in self.events if isinstance(one, kind)]


def received(flight: Flight, index: int, sequence: int, **changes) -> ReceivedStill:
    item = flight.still(index, sequence, **changes)
    return ReceivedStill(RoiHeader.parse(item.attachment, item.payload), item.payload)


class Gated:
    """Detects as another does, but waits to be let go each time, and sees nothing from one run on."""

    class_names = CLASSES

    def __init__(self, release, *, inner=None, taken=None, blind_from=None) -> None:
        self._release, self._inner, self._taken = release, inner or RedSquares(), taken
        self._blind_from = blind_from
        self.seen: list[np.ndarray] = []

    def detect(self, image_bgr):
        self.seen.append(image_bgr)
        blind = self._blind_from is not None and len(self.seen) >= self._blind_from
        if self._taken is not None:
            self._taken.release()
        assert self._release.acquire(timeout=60)
        return self._inner.detect(np.zeros_like(image_bgr) if blind else image_bgr)


def news_of(*, come: bool = True) -> threading.Event:
    """Set where there always are some."""
    news = threading.Event()
    if come:
        news.set()
    return news


def test_boxes_go_on_over_pictures_that_were_passed_over(pictures):
    """They stood still on each picture that the ground had no time for, while the camera moved on."""
    rig, looked_at = Rig(detect_every=1), Rig(detect_every=1)
    rig.look(pictures[:12])
    for picture in pictures[12:15]:
        rig.pipeline.pass_over(picture.frame_index, picture.capture_ns)
    rig.look([pictures[15]])
    looked_at.look(pictures[:16])
    seen, expected = rig.of(Overlay), looked_at.of(Overlay)
    assert [one.frame_index for one in seen] == list(range(16))
    looked_ns = [None] * 12 + [pictures[11].capture_ns] * 3 + [None]
    assert [one.looked_ns for one in seen] == looked_ns, "else they pass for seen"
    for one, right, still in zip(seen[12:15], expected[12:15], expected[11:14], strict=True):
        assert one.track_ids.tolist() == right.track_ids.tolist()
        off_px, stood_px = (np.abs(each.boxes_base_px - right.boxes_base_px).max() for each in (one, still))
        assert off_px < min(1.5, stood_px)


def test_each_frame_gives_an_overlay_with_the_track_where_the_object_is(pictures):
    """Boxes would lag behind the picture or be missing from some frames."""
    rig = Rig(detect_every=3).look(pictures)
    overlays = rig.of(Overlay)
    assert [one.frame_index for one in overlays] == list(range(30))
    assert rig.pipeline.counts.detections_run == 10
    assert rig.pipeline.counts.tracks == 1
    for one in overlays[6:]:
        assert one.track_ids.tolist() == [1]
        np.testing.assert_allclose(one.boxes_base_px[0], square_box(one.frame_index), atol=6)
        assert (one.classes, one.refined.tolist()) == (("car",), [False])


def test_only_pictures_that_are_searched_are_converted(flight, monkeypatch):
    """Converting each would take a ground longer than decoding it."""
    converted = []
    convert = YuvPicture.bgr
    monkeypatch.setattr(YuvPicture, "bgr", lambda self: converted.append(1) or convert(self))
    rig, decoder = Rig(detect_every=5), BaseDecoder()
    for unit in flight.units:
        picture = decoder.decode_yuv(unit.data)
        rig.pipeline.analyze(DecodedFrame(unit.frame_index, unit.capture_ns, None, picture), hurry=False)
    assert len(converted) == rig.pipeline.counts.detections_run == 6
    assert [one.track_ids.tolist() for one in rig.of(Overlay)[6:]] == [[1]] * 24


def test_a_slow_detector_holds_no_list_up_and_its_boxes_lie_where_objects_are_now(pictures):
    """Beside a browser lists came a second late, and the page showed none on the picture of now."""
    taken, release = threading.Semaphore(0), threading.Semaphore(0)
    slow, at_once = Gated(release, taken=taken), Rig(detect_every=5)
    rig = Rig(detect_every=5, detector=slow, detector_thread=DetectorThread())
    at_once.look(pictures)
    for picture in pictures:
        rig.pipeline.analyze(picture, hurry=False, news=news_of())
        if picture.frame_index % 5 == 0:
            assert taken.acquire(timeout=60), "else the next would take its place"
        if picture.frame_index % 5 == 2:  # what began two pictures ago
            release.release()
            eventually(lambda: rig.pipeline.searching is False, what="it is found")
    lists, expected = rig.of(Overlay), at_once.of(Overlay)
    assert [(one.frame_index, one.looked_ns) for one in lists] == [(index, None) for index in range(30)]
    for one, right in zip(lists, expected, strict=True):
        assert one.track_ids.tolist() == ([1] if one.frame_index > 2 else [])
        if one.frame_index % 5 >= 3:
            np.testing.assert_array_equal(one.boxes_base_px, right.boxes_base_px)
            assert (one.classes, one.confidences.tolist()) == (right.classes, right.confidences.tolist())
    assert rig.pipeline.objects_detected == 1


def test_lists_of_a_detector_that_is_a_second_behind_are_old(pictures):
    """Boxes that nobody has compared with a picture for so long would pass for seen."""
    release = threading.Semaphore(1)
    slow = Gated(release, inner=NothingSeen())
    rig = Rig(detect_every=5, detector=slow, detector_thread=DetectorThread())
    for picture in pictures[:24]:
        rig.pipeline.analyze(picture, hurry=False, news=news_of())
        if picture.frame_index == 0:
            eventually(lambda: not rig.pipeline.searching, what="the first is searched")
    rig.pipeline.pass_over(pictures[24].frame_index, pictures[24].capture_ns)
    rig.pipeline.edge_step(tracks_at(25, {7: (10.0, 10.0, 30.0, 30.0)}), capture_ns=pictures[25].capture_ns)
    due_ns = pictures[5].capture_ns
    assert [one.looked_ns for one in rig.of(Overlay)] == [None] * 21 + [due_ns] * 5
    release.release(100)


def test_a_picture_that_waits_for_the_detector_gives_way_to_the_newest(pictures):
    """Where many edges share it each would be searched in a picture that is seconds old."""
    go, thread = threading.Semaphore(1), DetectorThread()
    other = Rig(detect_every=5, detector=Gated(go, inner=NothingSeen()), detector_thread=thread)
    watched = Gated(threading.Semaphore(9), inner=NothingSeen())
    rig = Rig(detect_every=5, detector=watched, detector_thread=thread)
    for one in (other, rig):
        one.pipeline.analyze(pictures[0], hurry=False, news=news_of())
    eventually(lambda: not (other.pipeline.searching or rig.pipeline.searching), what="both see")
    other.pipeline.analyze(pictures[5], hurry=False, news=news_of())
    for picture in pictures[5:9]:
        rig.pipeline.analyze(picture, hurry=False, news=news_of())
    go.release()
    eventually(lambda: not rig.pipeline.searching, what="it is searched")
    np.testing.assert_array_equal(watched.seen, [as_bgr(pictures[index].picture) for index in (0, 8)])
    assert rig.pipeline.counts.detections_run == 2


def test_what_is_found_after_the_list_is_out_counts_though_nothing_comes(pictures):
    """After the last picture of a flight, or where the link pauses, stills would find no track at its frame."""
    release, news = threading.Semaphore(1), threading.Event()
    at_last = Gated(release, blind_from=2)
    rig = Rig(detect_every=5, detector=at_last, detector_thread=DetectorThread()).look([pictures[0]])
    news.set()
    rig.pipeline.analyze(pictures[5], hurry=False, news=news)
    assert (rig.pipeline.take_late(), rig.pipeline.objects_detected) == (True, 1)
    news.clear()
    release.release()
    assert news.wait(timeout=20), "who waits for news learns of it"
    assert (rig.pipeline.take_late(), rig.pipeline.objects_detected) == (False, 0)
    assert len(rig.of(Overlay)) == 2


@pytest.mark.parametrize("hangs_at", [0, 5])
def test_while_the_detector_hangs_all_else_goes_on(flight, pictures, hangs_at):
    """The edge's boxes came with the next picture alone, and a flight that ended meanwhile gave out no still."""
    release = threading.Semaphore(hangs_at // 5)
    rig = Rig(detect_every=5, detector=(slow := Gated(release)), detector_thread=DetectorThread())
    worker = RealtimeWorker(
        lambda one, hurry, news: rig.pipeline.analyze(one, hurry=hurry, news=news),
        lambda tracks, at_ns: rig.pipeline.edge_step(tracks, capture_ns=at_ns),
        rig.pipeline.read,
        name="x",
        take_late=rig.pipeline.take_late,
        finish_s=0.1,
        leave_s=20.0,
    )
    if hangs_at:
        worker.picture(pictures[0])
        eventually(lambda: worker.idle, what="the first is searched")
    worker.picture(pictures[hangs_at])
    eventually(lambda: len(slow.seen) == hangs_at // 5 + 1, what="it hangs")
    worker.step(tracks_at(hangs_at + 1, {7: square_box(hangs_at + 1)}), pictures[hangs_at + 1].capture_ns)
    worker.still(received(flight, hangs_at, 0))
    eventually(lambda: rig.reader.had_base, what="the still is read")
    assert (rig.of(Overlay)[-1].frame_index, bool(rig.of(Overlay)[-1].origins)) == (hangs_at + 1, True)
    assert not worker.idle
    assert worker.close()
    rig.pipeline.end()
    assert [one.still_sequence for one in rig.of(Refinement)] == [0]
    assert rig.pipeline.counts.detections_run == hangs_at // 5 + 1
    release.release(9)


def test_a_picture_that_was_never_searched_is_not_counted(pictures):
    """A ground whose detector hangs showed a detection that no picture had."""
    thread, go = DetectorThread(), threading.Event()
    thread.submit(pictures[0].picture, lambda _: Detections.none() if go.wait(timeout=20) else None)
    rig, news = Rig(detector_thread=thread), threading.Event()
    news.set()
    rig.pipeline.analyze(pictures[0], hurry=False, news=news)
    rig.pipeline.end()
    go.set()
    thread.submit(pictures[0].picture, lambda _: Detections.none()).found.result(timeout=20)
    assert rig.pipeline.counts.detections_run == 0


def test_small_objects_are_looked_at_enlarged_and_less_often(pictures):
    """They had no box; five runs as often as one would take the whole processor."""
    search = ScaleSearch(RedSquares().detect, confidence=0.25)
    search.enlarged = True
    rig = Rig(detect_every=3, search=search, detector=NothingSeen()).look(pictures)
    assert rig.pipeline.counts.detections_run == 6, "frames 0, 9 and 18, and in vain: then every third again"
    np.testing.assert_allclose(rig.of(Overlay)[0].boxes_base_px[0], square_box(0), atol=6)


def test_the_vehicles_that_are_seen_tell_the_tilt(pictures):
    """Of kinds aslant every second one is wrong."""
    rig, taken = Rig(detect_every=3), []
    rig.pipeline.tilt.take = lambda tracks, _names, *, height_px: taken.append((len(tracks), height_px))
    rig.look(pictures)
    assert taken == [(1, 192)] * 10


def test_a_kind_that_detections_do_not_agree_on_is_not_named(pictures):
    """A parked pickup was a car and a truck by turns for the whole flight."""

    class ByTurns(RedSquares):
        looks = 0

        def detect(self, image_bgr):
            self.looks += 1
            return replace(super().detect(image_bgr), class_ids=np.array([self.looks % 2], np.int32))

    said = []
    for detector in (RedSquares(), ByTurns()):
        rig = Rig(detector=detector, tilt=ViewTilt(vague_kinds=True), guesses=Guesses(fps=15))
        for picture in pictures[:12]:
            rig.pipeline.analyze(picture, hurry=False)
        said.append({word for one in rig.of(Overlay)[4:] for word in one.words})
    assert said == [{"car"}, {"vehicle"}]


@pytest.mark.parametrize(
    ("confidence", "least_px", "doubted"), [(0.7, 12, True), (0.95, 12, False), (0.95, 1000, True)]
)
def test_a_guess_stays_one_until_a_still_is_sure_of_it(
    flight, pictures, monkeypatch, confidence, least_px, doubted
):
    """Stills made firm pedestrians of lane marks, by .6, and of a shrub of nine pixels by .99."""
    monkeypatch.setattr(guesses, "LEAST_SURE_PX", least_px)

    class Doubts(Guesses):
        def among(self, ids):
            return np.ones(len(ids), np.bool_)

    rig = Rig(guesses=Doubts(fps=15), reader=SameAnswer(confidence=confidence))
    for picture in pictures[:6]:
        rig.pipeline.analyze(picture, hurry=False)
        if picture.frame_index == 3:
            rig.pipeline.read([received(flight, 3, 0)])
    after = rig.of(Overlay)[-1]
    assert (after.refined.tolist(), after.doubted.tolist()) == ([True], [doubted])
    assert [one.doubted for one in rig.of(Refinement)] == [doubted], "the list of stills says the same"


@pytest.mark.parametrize(
    ("confidence", "edge_classes", "doubted"),
    [
        (0.7, CLASSES, [True, True]),
        (0.95, CLASSES, [False, True]),
        (0.95, ("boat", *CLASSES), [False, False]),
    ],
    ids=["unsure", "sure", "another detector at the edge"],
)
def test_where_the_view_is_unlike_what_the_detector_knows_boxes_are_doubted(
    flight, pictures, confidence, edge_classes, doubted
):
    """In a marina 372 of 398 boxes had the names of cars: the edge had sent them, with the same detector."""
    trust, taken = ViewTrust(None, hence=""), []
    trust.take = lambda found: taken.append(len(found))
    reader = SameAnswer(confidence=confidence)
    rig = Rig(trust=trust, guesses=Guesses(fps=15), reader=reader, edge_classes=edge_classes)
    for picture in pictures[:20]:
        trust.unlike = picture.frame_index >= 10
        if picture.frame_index == 14:
            rig.pipeline.read([received(flight, 13, 0)])
        rig.pipeline.analyze(picture, hurry=False)
        rig.pipeline.edge_step(tracks_at(picture.frame_index, {2: (40.0, 100.0, 60.0, 120.0)}))
    overlays = {one.frame_index: one for one in rig.of(Overlay)}
    assert not overlays[9].doubted.any()
    assert overlays[12].doubted.tolist() == [True, doubted[1]]
    assert overlays[19].refined.tolist() == [True, False]
    assert overlays[19].doubted.tolist() == doubted
    assert [one.doubted for one in rig.of(Refinement)] == doubted[:1], "the list of stills says the same"
    assert taken == [1] * 20, "it is told by what is found"


def test_what_the_detector_shows_is_counted_without_what_the_edge_tells(pictures):
    """The edge would take its own tracks for what the ground sees, and stop sending them."""
    rig = Rig(detect_every=3, detector=Gated(threading.Semaphore(99), blind_from=6))
    assert rig.pipeline.objects_detected == -1
    counts = []
    for picture in pictures:
        rig.pipeline.analyze(picture, hurry=False)
        far = {number: (40.0 * number, 100.0, 40.0 * number + 20, 120.0) for number in (2, 3)}
        rig.pipeline.edge_step(tracks_at(picture.frame_index, far))
        counts.append(rig.pipeline.objects_detected)
    assert counts == [1] * 15 + [0] * 15
    assert len(rig.of(Overlay)[-1].track_ids) > 1


@pytest.mark.parametrize(
    ("every", "hurries", "runs"),
    [
        (1, lambda index: index % 4 != 0, 8),  # boxes would vanish whenever the machine is busy
        # On one that is always behind, whatever comes into view would never have a box: at 0, 8, 16 and 24.
        (2, lambda _index: True, 4),
    ],
)
def test_in_a_hurry_detection_waits_not_for_ever_and_the_track_goes_on(pictures, every, hurries, runs):
    """See each case."""
    rig = Rig(detect_every=every)
    for picture in pictures:
        rig.pipeline.analyze(picture, hurry=hurries(picture.frame_index))
    assert rig.pipeline.counts.detections_run == runs
    assert every > 1 or all(len(one.track_ids) == 1 for one in rig.of(Overlay)[8:])


def test_a_standing_picture_is_searched_less_often(pictures):
    """Half of a small ground's processor would go into what it has seen, and its boxes come late for it."""
    rig = Rig(detect_every=2, detect_still_every=10)
    for index in range(30):
        rig.pipeline.analyze(replace(pictures[0], frame_index=index), hurry=False)
    assert rig.pipeline.counts.detections_run == 3
    assert all(len(one.track_ids) == 1 for one in rig.of(Overlay))


def test_where_another_scene_begins_no_box_of_the_last_one_stays_and_the_new_one_is_searched_at_once(
    pictures,
):
    """Of a camera that is switched the old boxes, the edge's too, stood over the new picture for half a second."""
    rig = Rig(detect_every=8, detect_still_every=8)
    other = np.random.default_rng(2).integers(0, 2, (6, 10, 3), np.uint8) * 200
    other = cv2.resize(other, (320, 192), interpolation=cv2.INTER_CUBIC)
    other[100:132, 50:82] = (20, 20, 220)
    for picture in pictures[:10]:
        index = picture.frame_index
        rig.pipeline.analyze(replace(picture, picture=other) if index > 3 else picture, hurry=False)
        if index in (2, 5):  # a step of the scene before comes late
            rig.pipeline.edge_step(tracks_at(2 if index == 2 else 3, {32: (220.0, 20.0, 250.0, 50.0)}))
    assert [one.track_ids.tolist() for one in rig.of(Overlay)] == [[1]] * 3 + [[1, 2]] + [[]] + [[3]] * 5
    assert rig.pipeline.counts.detections_run == 2, "at 0 and at 5"


def test_a_still_changes_the_class_of_the_track_at_its_frame(flight, pictures):
    """The whole point: the sharp still says bus, and the track would go on being called car."""
    rig = Rig().look(pictures[:12])
    rig.pipeline.read([received(flight, 8, 0)])
    rig.look([pictures[12]])
    (refinement,) = rig.of(Refinement)
    assert (refinement.track_id, refinement.class_before, refinement.class_after) == (1, "car", "bus")
    assert (refinement.still_sequence, refinement.edge_track_id, refinement.frame_index) == (0, 1, 11)
    assert refinement.base_crop_bgr.shape == (32, 32, 3)
    assert refinement.base_crop_bgr[16, 16, 2] > 150, "the base crop shows the square of frame 8"
    last = rig.of(Overlay)[-1]
    assert (last.base_classes, last.classes, last.refined.tolist()) == (("car",), ("bus",), [True])
    counts = rig.pipeline.counts
    assert (counts.refined, counts.class_changes, dict(counts.outcomes)) == (1, 1, {"matched": 1})


def test_the_edge_hears_of_every_still_once(flight, pictures):
    """A lockstep edge would wait in vain; M3 would count an answer twice."""
    rig = Rig().look(pictures[:10])
    stills = [received(flight, 8, 0), received(flight, 9, 1, data=b"broken"), received(flight, 9, 2)]
    rig.pipeline.read(stills)
    results = rig.pipeline.take_results()
    (track_id,) = rig.of(Overlay)[-1].track_ids.tolist()
    # Those of one frame are read together; one that cannot be decoded is answered as no opinion.
    said = sorted((one.still_sequence, one.class_name, one.ground_track_id) for one in results)
    assert said == [(0, "bus", track_id), (1, "", -1), (2, "bus", track_id)]
    assert rig.pipeline.take_results() == []
    assert dict(rig.pipeline.counts.stills_dropped) == {"undecodable": 1}
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
    rig = Rig().look([pictures[0]])
    rig.pipeline.read([received(flight, 0, 0, **changes)])
    assert dict(rig.pipeline.counts.stills_dropped) == {"undecodable": 1}


def test_a_name_of_any_language_and_length_goes_back_to_the_edge(flight, pictures):
    """A classifier with names in Chinese would end the ground at its first still."""
    wordy = "乗用車\n" * 30
    rig = Rig(reader=SameAnswer(class_names=("car", wordy)), edge_classes=("car", wordy)).look([pictures[0]])
    rig.pipeline.read([received(flight, 0, 0)])
    (result,) = rig.pipeline.take_results()
    assert len(result.class_name.encode()) <= 64
    assert result.class_name.startswith("乗用車?乗用車")


def test_a_still_that_nobody_can_read_is_shown_all_the_same(flight, pictures):
    """Without a classifier the operator would not even see the sharp picture."""
    rig = Rig(reader=SameAnswer(knows=False)).look(pictures[:6])
    rig.pipeline.read([received(flight, 4, 0)])
    (refinement,) = rig.of(Refinement)
    assert (refinement.track_id, refinement.class_before, refinement.class_after) == (None, "car", "car")
    assert refinement.still[:2] == b"\xff\xd8"
    assert (rig.pipeline.counts.refined, dict(rig.pipeline.counts.outcomes)) == (0, {"unread": 1})


def test_a_picture_without_objects_is_an_empty_overlay_and_a_still_that_waits_is_given_out(flight):
    """An empty scene would show boxes of the past for ever, and the last stills be missing from the recording."""
    rig = Rig().look([DecodedFrame(0, 0, 0, np.full((192, 320, 3), 120, np.uint8))])
    (overlay,) = rig.of(Overlay)
    assert (overlay.boxes_base_px.shape, overlay.classes, rig.pipeline.counts.tracks) == ((0, 4), (), 0)
    rig.pipeline.read([received(flight, 9, 0)])  # its frame will not come
    assert rig.of(Refinement) == []
    rig.pipeline.end()
    assert [one.track_id for one in rig.of(Refinement)] == [None]
    assert sum(rig.pipeline.counts.outcomes.values()) == 1


# Residual stills


def residual(
    flight: Flight, pictures: list[DecodedFrame], index: int, sequence: int, **changes
) -> ReceivedStill:
    """A still of the red square that builds on the decoded frame, as the edge makes it."""
    crop = tuple(int(side) for side in square_box(index))
    sharp = flight.pictures[index][crop[1] : crop[3], crop[0] : crop[2]]
    view = View.fitted((320, 192), (320, 192), fit="letterbox")
    base = base_crop(pictures[index].picture, view=view, crop_source_px=crop, size=sharp.shape[1::-1])
    coded = still_codec("residual").encode(sharp, quality_pct=80, base_bgr=base)
    fields = {"data": coded.data, "codec": "residual", "parameters": coded.parameters} | changes
    return received(flight, index, sequence, **fields)


def test_a_residual_is_undone_on_the_frame_that_it_names(flight, pictures):
    """The still would be painted onto another moment: garbage that looks like a picture."""
    rig = Rig().look(pictures[:12])
    still = residual(flight, pictures, 6, 0)
    rig.pipeline.read([still])
    (refinement,) = rig.of(Refinement)
    x1, y1, x2, y2 = (int(side) for side in square_box(6))
    sharp = flight.pictures[6][y1:y2, x1:x2].astype(float)
    base = pictures[6].picture[y1:y2, x1:x2]
    assert np.square(refinement.still_bgr - sharp).mean() < 0.7 * np.square(base - sharp).mean()
    assert (refinement.track_id, refinement.class_after) == (1, "bus")
    assert refinement.crop_base_px == square_box(6)
    (result,) = rig.pipeline.take_results()
    assert (result.class_name, result.again) == ("bus", False)


def test_a_residual_whose_frame_is_not_at_hand_is_asked_for_again_once(flight, pictures):
    """The operator would never see the still; or the edge would send it for ever."""
    rig = Rig().look([*pictures[:5], *pictures[7:12]])
    lost = residual(flight, pictures, 6, 4)
    wrong = residual(flight, pictures, 8, 5, parameters={"b": 1}, data=lost.data)
    rig.pipeline.read([lost, wrong])
    rig.look([pictures[12]])
    rig.pipeline.end()
    results = rig.pipeline.take_results()
    said = [(one.still_sequence, one.track_id, one.class_name, one.again) for one in results]
    assert said == [(4, 1, "", True), (5, 1, "", True)]
    assert dict(rig.pipeline.counts.stills_dropped) == {"base_missing": 2}
    notices = [one.text.partition(":")[0] for one in rig.of(Notice)]
    assert notices == [f"still {number} is asked for again" for number in (4, 5)]
    assert rig.of(Refinement) == []


def test_a_residual_before_its_frame_waits_for_it(flight, pictures):
    """Each residual that overtakes its frame in the decoder's queue would cost an intra still more."""
    rig = Rig().look(pictures[:6])
    rig.pipeline.read([residual(flight, pictures, 7, 0), residual(flight, pictures, 8, 1)])
    assert rig.pipeline.take_results() == []
    rig.look([pictures[6]])
    assert rig.pipeline.take_results() == []
    rig.look([pictures[7]])
    (result,) = rig.pipeline.take_results()
    assert (result.still_sequence, result.class_name, result.again) == (0, "bus", False)
    rig.pipeline.analyze(pictures[9], hurry=False)  # frame 8 was lost
    (result,) = rig.pipeline.take_results()
    assert (result.still_sequence, result.again) == (1, True)


def test_stills_that_wait_are_bounded(flight, pictures):
    """A peer that names frames of the future would fill the memory."""
    rig = Rig().look([pictures[0]])
    one = residual(flight, pictures, 5, 0)
    rig.pipeline.read([ReceivedStill(replace(one.header, sequence=i), one.data) for i in range(70)])
    assert [result.still_sequence for result in rig.pipeline.take_results()] == list(range(6))


def test_a_reader_that_wants_the_picture_gets_it(flight, pictures):
    """Re-detection would be given a still without surroundings, and say nothing."""
    rig = Rig(reader=SameAnswer(wants_base=True)).look(pictures[:4])
    rig.pipeline.read([received(flight, 5, 0)])
    assert rig.reader.had_base == []
    rig.look([pictures[4]])
    rig.pipeline.analyze(pictures[6], hurry=False)  # frame 5 has no picture: that of frame 4 serves
    assert rig.reader.had_base == [True]


# Shared stills


def test_each_object_in_a_still_gets_its_own_answer(flight, pictures):
    """The neighbours in a shared still would stay unrefined, and the edge would send them again."""
    rig = Rig().look(pictures[:10])
    here = square_box(8)
    rig.pipeline.edge_step(tracks_at(8, {1: here, 7: (200.0, 20.0, 240.0, 60.0)}))
    also = (AlsoShown(track_id=7, box_source_px=(200.0, 20.0, 240.0, 60.0)),)
    rig.pipeline.read([received(flight, 8, 3, also=also)])
    results = rig.pipeline.take_results()
    said = [(one.still_sequence, one.track_id, one.ground_track_id, one.class_name) for one in results]
    assert said == [(3, 1, 1, "bus"), (3, 7, 2, "bus")]
    shown = rig.of(Refinement)
    assert [(one.edge_track_id, one.track_id, one.still_sequence) for one in shown] == [(1, 1, 3), (7, 2, 3)]
    assert shown[1].box_base_px == (200.0, 20.0, 240.0, 60.0)
    assert rig.pipeline.counts.refined == 2
    rig.pipeline.read([received(flight, 8, 4, also=also, data=b"broken")])
    assert [(one.track_id, one.class_name) for one in rig.pipeline.take_results()] == [(1, ""), (7, "")]


def test_new_objects_and_boxes_of_a_still_enter_the_list(flight, pictures):
    """Re-detection would find objects in vain."""
    new = (250.0, 10.0, 280.0, 40.0)
    found = Detections(np.array([new], np.float32), np.array([0.8], np.float32), np.array([1], np.int32))
    x1, y1, x2, y2 = square_box(8)
    rig = Rig(reader=SameAnswer(found=found, at=(x1 + 8, y1, x2 + 8, y2))).look(pictures[:9])
    before = rig.pipeline.list_at(9).boxes_base_px[0, 0]
    rig.pipeline.read([received(flight, 8, 0)])
    last = rig.pipeline.list_at(9)
    assert last.origins == ("base", "still")
    assert last.base_classes == ("car", "bus")
    np.testing.assert_allclose(last.boxes_base_px[1], new)
    assert last.boxes_base_px[0, 0] > before + 2


# The edge's tracks


def test_the_edges_tracks_and_ours_are_one_list(pictures):
    """What only the edge sees would not be shown, or what both see twice."""
    rig = Rig()
    far = (220.0, 20.0, 250.0, 50.0)
    for picture in pictures[:12]:
        rig.pipeline.analyze(picture, hurry=False)
        if picture.frame_index == 6:
            rig.pipeline.edge_step(tracks_at(5, {31: square_box(5), 32: far}))
    overlays = rig.of(Overlay)
    assert [one.frame_index for one in overlays] == list(range(12))
    assert overlays[6].origins == ("base",)
    assert overlays[7].origins == ("edge+base", "edge")
    assert overlays[7].track_ids.tolist() == [1, 2]
    np.testing.assert_allclose(overlays[7].boxes_base_px[1], far, atol=0.1)
    np.testing.assert_allclose(overlays[7].boxes_base_px[0], square_box(7), atol=8)
    assert rig.pipeline.counts.tracks == 2
    assert rig.pipeline.counts.steps_used == 1


def test_what_has_left_the_picture_is_listed_no_more(pictures):
    """The edge's last word on an object that drives out of view would stand at the border, and count as an object."""
    rig = Rig()
    for picture in pictures[:14]:
        rig.pipeline.analyze(picture, hurry=False)
        if picture.frame_index in (3, 5):  # eight pixels a frame to the right, the border is at 320
            left = 270.0 + 8 * picture.frame_index
            rig.pipeline.edge_step(
                tracks_at(picture.frame_index, {32: (left, 20.0, min(left + 30, 320.0), 40.0)})
            )
    leaving = {one.frame_index: one.boxes_base_px[one.boxes_base_px[:, 1] < 50] for one in rig.of(Overlay)}
    assert len(leaving[4]) == len(leaving[6]) == 1
    assert [frame for frame, boxes in leaving.items() if len(boxes) and frame > 8] == []
    assert all((boxes[:, 2] > boxes[:, 0]).all() for boxes in leaving.values())


def test_a_still_of_a_track_that_only_the_edge_sees_refines_it(flight, pictures):
    """On a bad base nothing would ever be refined: the ground has no track there."""
    far = (220.0, 20.0, 250.0, 50.0)
    rig = Rig().look(pictures[:9])
    rig.pipeline.edge_step(tracks_at(6, {32: far}))
    crop = (216, 16, 254, 54)
    data = cv2.imencode(".jpg", flight.pictures[6][16:54, 216:254])[1].tobytes()
    still = received(flight, 6, 0, data=data, track_id=32, box_source_px=far, crop_source_px=crop)
    rig.pipeline.read([still])
    (refinement,) = rig.of(Refinement)
    assert (refinement.track_id, refinement.class_after) == (2, "bus")
    rig.look([pictures[9]])
    last = rig.of(Overlay)[-1]
    assert (last.classes[1], last.refined.tolist(), last.origins[1]) == ("bus", [False, True], "edge")


def test_a_step_of_a_tick_without_a_picture_is_shown(pictures):
    """At one frame a second on the base the boxes would move once a second."""
    rig = Rig().look([pictures[0]])
    rig.look([pictures[5]])
    rig.pipeline.edge_step(tracks_at(8, {31: square_box(8)}), capture_ns=123)
    rig.pipeline.edge_step(tracks_at(7, {31: square_box(7)}))  # older than the last
    rig.pipeline.analyze(pictures[7], hurry=False)  # its picture was late
    rig.look([pictures[10]])
    rig.pipeline.edge_step(tracks_at(2**32 - 1, {31: square_box(10)}))  # nonsense: nothing could follow it
    rig.look([pictures[11]])
    overlays = rig.of(Overlay)
    assert [one.frame_index for one in overlays] == [0, 5, 8, 10, 11]
    assert overlays[2].capture_ns == 123
    assert overlays[2].origins == ("edge+base",)
    np.testing.assert_allclose(overlays[2].boxes_base_px[0], square_box(8), atol=8)
    assert len({one.track_ids.tolist()[0] for one in overlays[2:]}) == 1


def test_a_still_of_a_tick_without_a_picture_finds_its_track(flight, pictures):
    """Where the base has few frames most stills would match nothing."""
    rig = Rig()
    for index in (0, 3, 6, 9, 12):
        rig.pipeline.analyze(pictures[index], hurry=False)
    rig.pipeline.read([received(flight, 8, 0)])
    (refinement,) = rig.of(Refinement)
    assert refinement.track_id == 1


def test_looking_ahead_tells_what_would_be_shown_and_changes_nothing(pictures):
    """A study that asks at every frame would measure another ground than the one that flies."""
    plain, asked = Rig(detect_every=5), Rig(detect_every=5)
    for rig in (plain, asked):
        rig.look([pictures[0]])
        for picture in pictures[1:20]:
            if rig is asked:
                ahead = rig.pipeline.list_at(picture.frame_index + 3)
                assert ahead.frame_index == picture.frame_index + 3
            rig.pipeline.analyze(picture, hurry=False)
            if picture.frame_index % 6 == 0:
                rig.pipeline.edge_step(tracks_at(picture.frame_index, {31: square_box(picture.frame_index)}))
    for a, b in zip(plain.of(Overlay), asked.of(Overlay), strict=True):
        np.testing.assert_array_equal(a.boxes_base_px, b.boxes_base_px)
        np.testing.assert_array_equal(a.track_ids, b.track_ids)
    now = asked.pipeline.list_at(19)
    np.testing.assert_allclose(now.boxes_base_px, asked.of(Overlay)[-1].boxes_base_px)
    np.testing.assert_allclose(asked.pipeline.list_at(22).boxes_base_px[0], square_box(22), atol=8)
    with pytest.raises(ValueError, match="frame 18 lies before"):
        asked.pipeline.list_at(18)
    assert len(Rig().pipeline.list_at(0).track_ids) == 0
