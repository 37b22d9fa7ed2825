"""How stills are named: on the crop alone, or on the picture with the crops pasted in."""

import dataclasses

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_common.inference.classify import open_classifier
from hvt_common.inference.detect import open_detector
from hvt_common.values import Detections, Image, View, iou
from hvt_ground.perception.stills.classify import CropReader, NoReader, ObjectReading, object_crops
from hvt_ground.perception.stills.decode import DecodedStill
from hvt_models.redetection import Redetection, composite
from media.onnx_models import colour_classifier
from rigs.examples import detections

SOURCE, BASE = (1280, 720), (320, 180)
VIEW = View.fitted(SOURCE, BASE, fit="letterbox")
GREY = np.full((180, 320, 3), 100, np.uint8)


def decoded(
    crop: tuple[int, int, int, int], *, colour=(0, 0, 255), size: tuple[int, int] | None = None
) -> DecodedStill:
    """A still of one colour; ``size`` as coded."""
    width, height = size or (crop[2] - crop[0], crop[3] - crop[1])
    image = np.full((height, width, 3), colour, np.uint8)
    x1, y1, x2, y2 = VIEW.to_base(np.array([crop], np.float32))[0].tolist()
    return DecodedStill(image, crop, ((x1, y1, x2, y2),), 0)


class Bright:
    """Detects what is saturated: red is a car, green a bus."""

    class_names = ("car", "bus", "van")

    def detect(self, image_bgr: Image) -> Detections:
        boxes, classes = [], []
        for class_id, channel in ((0, 2), (1, 1)):
            others = [one for one in range(3) if one != channel]
            mask = (image_bgr[..., channel] > 180) & (image_bgr[..., others].max(axis=2) < 90)
            count, _, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
            for x, y, width, height, area in stats[1:count]:
                if area > 20:
                    boxes.append([x, y, x + width, y + height])
                    classes.append(class_id)
        return detections(boxes, 0.8, classes)


def test_redetection_names_each_still_by_what_is_found_at_its_place():
    """The class of the neighbour would be taken for the object's own."""
    base = GREY.copy()
    base[100:120, 200:220] = (0, 255, 0)  # another object, in the base itself
    stills = [
        decoded((400, 200, 480, 280)),
        decoded((40, 40, 120, 120), colour=(0, 255, 0)),
        decoded((1000, 40, 1080, 120), colour=(100, 100, 100)),  # shows nothing
    ]
    read = Redetection(Bright(), view=VIEW).read(stills, base)
    (first,), (second,), (third,) = read.objects
    assert (first.posterior.class_name, first.posterior.confidence) == ("car", pytest.approx(0.8))
    assert first.box_base_px == pytest.approx((100, 50, 120, 70), abs=1)
    assert second.posterior.class_name == "bus"
    assert third == ObjectReading(None, None)
    np.testing.assert_allclose(first.posterior.probabilities, [0.8, 0.1, 0.1], atol=1e-6)
    entropy = -(0.8 * np.log(0.8) + 0.2 * np.log(0.1))
    assert first.posterior.entropy_nats == pytest.approx(entropy, abs=1e-5)
    assert len(read.found) == 0, "what the base shows elsewhere is not news"


class Says:
    """A detector that gives the same answer for every picture, and keeps the pictures."""

    class_names = ("car", "bus", "van")

    def __init__(self, *rows: tuple[tuple[float, float, float, float], float, int]) -> None:
        self.rows = rows
        self.seen: list[Image] = []

    def detect(self, image_bgr: Image) -> Detections:
        self.seen.append(image_bgr)
        boxes, confidences, classes = zip(*self.rows, strict=True) if self.rows else ((), (), ())
        return detections(boxes, confidences, classes)


STILL = decoded((400, 200, 480, 280))


def test_all_stills_of_a_frame_are_one_run_and_without_its_picture_none():
    """Four stills would cost four networks' time; one whose frame was lost be named by another moment's picture."""
    detector = Says(((100, 50, 120, 70), 0.6, 0))
    reader = Redetection(detector, view=VIEW)
    assert reader.read([], GREY).objects == ()
    read = reader.read([STILL], None)
    assert (read.objects, len(read.found), detector.seen) == (((ObjectReading(),),), 0, [])
    reader.read([STILL, decoded((40, 40, 120, 120))], GREY)
    (picture,) = detector.seen
    assert picture[60, 110].tolist() == picture[20, 20].tolist() == [0, 0, 255]


@pytest.mark.parametrize(
    ("found", "probabilities"),
    [
        # A van that is nearly a car would be told to the policy as certain, or as any of ten classes. The bus covers
        # half of the place only: it casts doubt, and does not name the object.
        (
            [((101, 50, 121, 70), 0.4, 0), ((100, 50, 120, 70), 0.5, 2), ((100, 50, 120, 60), 0.9, 1)],
            (4, 5, 5),
        ),
        ([((101, 50, 121, 70), 0.4, 0), ((100, 50, 120, 70), 0.5, 2)], (4, 1, 5)),
        ([((100, 50, 120, 70), 1.0, 2)], (0, 0, 1)),  # a logarithm of nothing would end the ground
    ],
)
def test_a_second_opinion_at_the_same_place_counts(found, probabilities):
    """See each case."""
    ((reading,),) = Redetection(Says(*found), view=VIEW).read([STILL], GREY).objects
    expected = np.array(probabilities) / sum(probabilities)
    assert (reading.posterior.class_name, reading.box_base_px) == ("van", (100, 50, 120, 70))
    assert reading.posterior.confidence == pytest.approx(expected[2])
    np.testing.assert_allclose(reading.posterior.probabilities, expected, atol=1e-6)
    assert (reading.posterior.entropy_nats == 0) == (probabilities == (0, 0, 1))


def test_a_detection_speaks_for_one_object_only():
    """The car in front would give its class to the one that it hides."""
    near, behind = (100.0, 50.0, 120.0, 70.0), (108.0, 50.0, 128.0, 70.0)
    still = dataclasses.replace(decoded((400, 200, 520, 280)), boxes_base_px=(near, behind))
    ((lead, also),) = Redetection(Says((near, 0.6, 0)), view=VIEW).read([still], GREY).objects
    assert (lead.posterior.class_name, also) == ("car", ObjectReading())


def test_what_nobody_named_inside_a_still_is_found():
    """A pedestrian beside the car, sharp in its still, would never become a track."""
    named = (100.0, 50.0, 120.0, 70.0)
    detector = Says(
        (named, 0.9, 0),
        ((102, 52, 122, 72), 0.6, 1),  # the named object once more
        ((121, 51, 127, 60), 0.7, 2),  # new
        ((122, 62, 127, 69), 0.3, 2),  # new, and hardly there
        ((124, 40, 134, 60), 0.9, 0),  # mostly beside the still: the base shows it
        ((200, 50, 220, 70), 0.9, 0),  # elsewhere
    )
    still = dataclasses.replace(decoded((396, 196, 516, 284)), boxes_base_px=(named,))
    found = Redetection(detector, view=VIEW).read([still], GREY).found
    assert (found.boxes_xyxy_px.tolist(), found.class_ids.tolist()) == ([[121, 51, 127, 60]], [2])
    assert found.confidences.tolist() == [pytest.approx(0.7)]
    keen = Redetection(detector, view=VIEW, new_confidence=0.2).read([still], GREY).found
    assert len(keen) == 2


@pytest.mark.realdata
def test_a_network_larger_than_the_base_gets_the_stills_detail(data, monkeypatch):
    """At a 640 base every still would be blurred to it before the network looks."""
    detector = open_detector(str(data / "models" / "yolov5su_visdrone_736x1280.onnx"), confidence=0.1)
    with av.open(str(data / "clips" / "drone_carpark.mp4")) as clip:
        source = next(clip.decode(video=0)).to_ndarray(format="bgr24")
    size = (source.shape[1], source.shape[0])
    view = View.fitted(size, (640, 384), fit="letterbox")
    truth = detector.detect(source)
    base = composite(
        np.zeros((384, 640, 3), np.uint8),
        [DecodedStill(source, (0, 0, *size), ((0, 0, 1, 1),), 0)],
        view=view,
    )
    base = cv2.resize(cv2.resize(base, (160, 96), interpolation=cv2.INTER_AREA), (640, 384))
    stills = []
    for box in truth.boxes_xyxy_px[:12]:
        x1, y1, x2, y2 = np.clip(box + np.array([-8, -8, 8, 8]), 0, [*size, *size]).astype(int).tolist()
        place = tuple(view.to_base(box[None])[0].tolist())
        stills.append(DecodedStill(source[y1:y2, x1:x2], (x1, y1, x2, y2), (place,), 0))
    seen, detect = [], detector.detect
    monkeypatch.setattr(detector, "detect", lambda image_bgr: seen.append(image_bgr) or detect(image_bgr))
    readings = [reading for (reading,) in Redetection(detector, view=view).read(stills, base).objects]
    right = [
        reading.posterior is not None
        and reading.posterior.class_name == detector.class_names[class_id]
        and iou(np.array([reading.box_base_px]), np.array(still.boxes_base_px))[0, 0] > 0.75
        for reading, class_id, still in zip(readings, truth.class_ids, stills, strict=False)
    ]
    assert sum(right) >= 11
    assert [picture.shape for picture in seen] == [(720, 1200, 3)], "as large as the source, not the network"


@pytest.fixture
def reader(tmp_path) -> CropReader:
    names = tmp_path / "names.txt"
    names.write_text("red\ngreen\nblue\n")
    model = colour_classifier(tmp_path / "colour.onnx")
    return CropReader(open_classifier(str(model), labels=names), view=VIEW)


def test_the_crop_reader_gives_the_classifiers_answers_in_order(reader):
    """Two objects of one frame would swap their classes, or a van and the car beside it in one still share one."""
    stills = [decoded((0, 0, 40, 40), colour=colour) for colour in ((255, 0, 0), (0, 255, 0), (0, 0, 255))]
    image = np.zeros((50, 100, 3), np.uint8)  # coded at half the size of its crop
    image[:, :50], image[:, 50:] = (0, 0, 255), (255, 0, 0)
    boxes = ((102.0, 52.0, 123.0, 73.0), (127.0, 52.0, 148.0, 73.0))
    shared = DecodedStill(image, (400, 200, 600, 300), boxes, 0)
    read = reader.read([*stills, shared], None)
    said = [[one.posterior.class_name for one in objects] for objects in read.objects]
    assert said == [["blue"], ["green"], ["red"], ["red", "blue"]]
    assert reader.class_names == ("red", "green", "blue")
    assert [one.shape[:2] for one in object_crops(shared, view=VIEW)] == [(50, 53)] * 2


@given(st.lists(st.tuples(*[st.floats(-50, 400, width=32)] * 4), min_size=1, max_size=3))
def test_no_box_of_a_still_is_too_odd_to_cut(corners):
    """A header with a box outside its crop would end the ground."""
    boxes = [(min(a, c), min(b, d), max(a, c), max(b, d)) for a, b, c, d in corners]
    still = DecodedStill(np.zeros((40, 60, 3), np.uint8), (400, 200, 460, 240), tuple(boxes), 0)
    assert all(min(crop.shape) >= 1 for crop in object_crops(still, view=VIEW))


def test_without_any_model_stills_have_no_name():
    """A ground without models would not start."""
    both = dataclasses.replace(decoded((0, 0, 9, 9)), boxes_base_px=((0.0, 0.0, 1.0, 1.0),) * 2)
    silent = ObjectReading()
    assert NoReader().read([decoded((0, 0, 9, 9)), both], GREY).objects == ((silent,), (silent, silent))
