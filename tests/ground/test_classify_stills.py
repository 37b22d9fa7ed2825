"""How stills are named: on the crop alone, or on the picture with the crops pasted in."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_common.values import Detections, Image, View
from hvt_common.vision.classify import open_classifier
from hvt_ground.classify_stills import CropReader, Decoded, NoReader, Redetection, composite
from onnx_models import colour_classifier

SOURCE, BASE = (1280, 720), (320, 180)
VIEW = View.fitted(SOURCE, BASE, fit="letterbox")
GREY = np.full((180, 320, 3), 100, np.uint8)


def decoded(
    crop: tuple[int, int, int, int], *, colour=(0, 0, 255), size: tuple[int, int] | None = None
) -> Decoded:
    """A still of one colour; ``size`` as coded."""
    width, height = size or (crop[2] - crop[0], crop[3] - crop[1])
    image = np.full((height, width, 3), colour, np.uint8)
    x1, y1, x2, y2 = VIEW.to_base(np.array([crop], np.float32))[0].tolist()
    return Decoded(image, crop, (x1, y1, x2, y2), 0)


class Bright:
    """Detects what is saturated: red is a car, green a bus."""

    class_names = ("car", "bus", "van")

    def detect(self, image_bgr: Image) -> Detections:
        """Boxes of coloured areas."""
        boxes, classes = [], []
        for class_id, channel in ((0, 2), (1, 1)):
            others = [one for one in range(3) if one != channel]
            mask = (image_bgr[..., channel] > 180) & (image_bgr[..., others].max(axis=2) < 90)
            count, _, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
            for x, y, width, height, area in stats[1:count]:
                if area > 20:
                    boxes.append([x, y, x + width, y + height])
                    classes.append(class_id)
        return Detections(
            np.array(boxes, np.float32).reshape(-1, 4),
            np.full(len(boxes), 0.8, np.float32),
            np.array(classes, np.int32),
        )


def test_the_still_takes_its_place_at_base_resolution():
    """The detector would look for the object where it is not."""
    picture = composite(GREY, [decoded((400, 200, 480, 280))], view=VIEW)
    assert picture.shape == GREY.shape
    assert (picture[50:70, 100:120] == (0, 0, 255)).all()
    outside = picture.copy()
    outside[50:70, 100:120] = 100
    assert (outside == 100).all()
    assert (GREY == 100).all(), "the decoded picture is left alone"


def test_stills_at_the_border_and_shrunk_stills_fit():
    """One object at the edge of the picture would end the ground."""
    stills = [
        decoded((0, 0, 41, 33)),
        decoded((1240, 690, 1280, 720), colour=(0, 255, 0)),
        decoded((600, 100, 1240, 600), size=(512, 400)),  # coded smaller than its crop
        decoded((300, 300, 302, 301)),  # less than a pixel of the base
    ]
    picture = composite(GREY, stills, view=VIEW)
    assert picture[2, 2].tolist() == [0, 0, 255]
    assert picture[-1, -1].tolist() == [0, 255, 0]
    assert picture[90, 230].tolist() == [0, 0, 255]


@given(
    st.tuples(st.integers(0, 1279), st.integers(0, 719), st.integers(1, 700), st.integers(1, 700)),
    st.sampled_from(["letterbox", "crop"]),
    st.sampled_from([(320, 180), (180, 320), (64, 64), (2560, 1440)]),
)
def test_any_crop_of_any_view_can_be_pasted(box, fit, base):
    """Some aspect ratio would end the ground."""
    x, y, width, height = box
    crop = (x, y, min(1280, x + width), min(720, y + height))
    view = View.fitted(SOURCE, base, fit=fit)
    picture = np.full((base[1], base[0], 3), 100, np.uint8)
    still = Decoded(np.full((crop[3] - crop[1], crop[2] - crop[0], 3), 200, np.uint8), crop, (0, 0, 1, 1), 0)
    pasted = composite(picture, [still], view=view)
    assert pasted.shape == picture.shape
    assert set(np.unique(pasted)) <= {100, 200}


def test_redetection_names_each_still_by_what_is_found_at_its_place():
    """The class of the neighbour would be taken for the object's own."""
    base = GREY.copy()
    base[100:120, 200:220] = (0, 255, 0)  # another object, in the base itself
    stills = [
        decoded((400, 200, 480, 280)),
        decoded((40, 40, 120, 120), colour=(0, 255, 0)),
        decoded((1000, 40, 1080, 120), colour=(100, 100, 100)),  # shows nothing
    ]
    first, second, third = Redetection(Bright(), view=VIEW).read(stills, base)
    assert (first.class_name, first.confidence) == ("car", pytest.approx(0.8))
    assert second.class_name == "bus"
    assert third is None
    np.testing.assert_allclose(first.probabilities, [0.8, 0.1, 0.1], atol=1e-6)
    assert first.entropy_nats == pytest.approx(-(0.8 * np.log(0.8) + 0.2 * np.log(0.1)), abs=1e-5)


def test_redetection_without_the_picture_says_nothing():
    """A still whose frame was lost would be named by a picture of another moment."""
    reader = Redetection(Bright(), view=VIEW)
    assert reader.read([decoded((400, 200, 480, 280))], None) == [None]
    assert reader.class_names == ("car", "bus", "van")


def test_a_certain_detector_has_no_entropy():
    """A logarithm of nothing would end the ground."""

    class Sure(Bright):
        class_names = ("car",)

        def detect(self, image_bgr):
            found = super().detect(image_bgr)
            return Detections(
                found.boxes_xyxy_px, np.ones_like(found.confidences), np.zeros_like(found.class_ids)
            )

    (answer,) = Redetection(Sure(), view=VIEW).read([decoded((400, 200, 480, 280))], GREY)
    assert (answer.class_name, answer.entropy_nats) == ("car", 0.0)
    assert answer.probabilities.tolist() == [1.0]


def test_the_crop_reader_gives_the_classifiers_answers_in_order(tmp_path):
    """Two objects of one frame would swap their classes."""
    names = tmp_path / "names.txt"
    names.write_text("red\ngreen\nblue\n")
    model = colour_classifier(tmp_path / "colour.onnx")
    reader = CropReader(open_classifier(str(model), labels=names))
    stills = [decoded((0, 0, 40, 40), colour=colour) for colour in ((255, 0, 0), (0, 255, 0), (0, 0, 255))]
    assert [one.class_name for one in reader.read(stills, None)] == ["blue", "green", "red"]
    assert reader.class_names == ("red", "green", "blue")


def test_without_any_model_stills_have_no_name():
    """A ground without models would not start."""
    assert NoReader().read([decoded((0, 0, 9, 9))] * 2, GREY) == [None, None]
