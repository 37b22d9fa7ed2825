"""What three detectors say of a picture that nobody labelled."""

import numpy as np

from hvt_train.pictures.camera import Said, agreed, without_what_stands
from hvt_train.pictures.kinds import BIKE, ID, LARGE_VEHICLE, VEHICLE

AREA_PX = 640 * 360


def said(teacher, name, score, x, *, side=30):
    return Said(teacher, name, score, np.array([x, 50, x + side, 50 + side], np.float32))


def test_two_that_are_sure_make_a_label_and_one_that_is_not_makes_no_ground():
    """A car that one detector overlooks would be taught as road, or a shadow that one of them shouts at as a car."""
    boxes, kinds = agreed(
        [
            *(said(0, "vehicle", 0.3, 100), said(1, "car", 0.6, 103), said(2, "truck", 0.2, 99)),
            *(said(0, "vehicle", 0.3, 200), said(2, "car", 0.3, 200)),
            said(2, "car", 0.9, 300),
            said(0, "person", 0.6, 400),
            *(said(1, "truck", 0.7, 500), said(2, "bus", 0.5, 500)),
            *(said(0, "bike", 0.5, 560), said(1, "bench", 0.9, 20)),
        ],
        area_px=AREA_PX,
    )
    assert dict(zip(boxes[:, 0].astype(int).tolist(), kinds.tolist(), strict=True)) == {
        100: ID["car"],
        200: VEHICLE,
        300: -1,
        400: ID["pedestrian"],
        500: LARGE_VEHICLE,
        560: BIKE,
    }


def test_half_a_picture_is_not_left_out_for_a_guess():
    """A weak box around the whole road would take all of its ground from training."""
    found = [said(0, "vehicle", 0.2, 0, side=300), said(1, "car", 0.12, 0, side=40)]
    boxes, _ = agreed(found, area_px=AREA_PX)
    assert boxes[:, 2].tolist() == [40]


def test_what_stands_at_one_place_in_a_cameras_pictures_is_ground_and_who_is_sure_stays():
    """Signs and lane marks would count neither way for ever, and the network would go on calling them vehicles."""
    sign, car = np.array([10, 10, 60, 30], np.float32), np.array([100, 100, 140, 130], np.float32)
    pictures = [
        [
            Said(0, "vehicle", 0.3 if number else 0.7, sign + number % 2),
            Said(0, "vehicle", 0.3, car + 60 * number),
            Said(1, "toothbrush", 0.9, car),
        ]
        for number in range(4)
    ]
    left = without_what_stands(pictures)
    assert [len(picture) for picture in left] == [2, 1, 1, 1]
    assert all(picture[-1].box_px is boxes[1].box_px for picture, boxes in zip(left, pictures, strict=True))
