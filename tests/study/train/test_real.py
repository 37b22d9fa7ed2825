"""The public sets that training reads: what is left out, what a class becomes, and scores that are calibrated."""

import cv2
import numpy as np
import pytest

from hvt_common.values import Detections
from hvt_train.learning.calibration import fit_calibration
from hvt_train.pictures.kinds import ID, LARGE_VEHICLE
from hvt_train.pictures.pool import through_x265
from hvt_train.pictures.real import HeldOut, fill_real, held_out_pictures
from hvt_train.pictures.views import ViewSettings, ViewSource, read_picture
from studies.real_sets import write_hit, write_yolo

JUDGED = ("20210115", "20210123")
KEPT = ("20210114", "20210119")
TRAINED = ("20210112", "20210120")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """All three sets, small: see each test for what is in them."""
    folder = tmp_path_factory.mktemp("real")
    four = [(kind, 100 + 100 * kind, 200, 140 + 100 * kind, 220) for kind in range(4)]
    write_yolo(folder / "kit_ais", {"MOS155": four, "StuttgartA": four[:1], "MunichStreet02-MOS74": four})
    write_hit(folder / "hit_uav", [*JUDGED, *KEPT, *TRAINED])
    vehicles = [(0, 100, 100, 158, 152), (0, 300, 300, 450, 360)]  # a car, and one of 150 pixels
    write_yolo(folder / "cats_madison", {"0_13": vehicles, "0_20": vehicles, "99_99": vehicles})
    afloat = [(0, 20, 20, 40, 40), (1, 60, 60, 90, 80), (2, 100, 20, 120, 40), (4, 100, 100, 110, 110)]
    write_yolo(folder / "seadronessee", {"seq00_10": afloat, "seq00_300": afloat, "seq02_900": afloat})
    return folder


@pytest.fixture(scope="module")
def pool(data, tmp_path_factory):
    """What `fill_real` makes of them, by name; x265 codes the last of six pictures alone."""
    with pytest.MonkeyPatch.context() as short:
        short.setattr("hvt_train.pictures.pool.through_x265", lambda six, bps: through_x265(six[-1:], bps))
        files = fill_real(tmp_path_factory.mktemp("pool"), data)
    return {path.stem: (path, read_picture(path)) for path in files}


def of_kind(pool, kind):
    return [picture for name, (_, picture) in pool.items() if name.startswith(kind)]


def test_what_judges_is_never_trained_on(pool, data):
    """Every figure in docs/models.md would be that of pictures that the network knows by heart."""
    assert len(of_kind(pool, "thermal")) == len(TRAINED)
    assert len(of_kind(pool, "kit")) == 2  # not MunichStreet02
    kept = list(held_out_pictures(data))
    assert len(kept) == 2  # MunichStreet02, and every fourth of the two held-out dates
    assert kept[0].image_bgr.shape[0] == 720
    assert kept[1].image_bgr.shape == (720, 900, 3)


def test_who_swims_is_a_person_and_what_floats_is_a_boat_or_nothing(pool):
    """Buoys would be boats, and the flight that is measured would be known by heart."""
    water = of_kind(pool, "water")
    own = [ID["pedestrian"], ID["boat"], ID["boat"], -1]
    assert [picture.class_ids.tolist() for picture in water] == [own] * 2


@pytest.mark.parametrize("date", JUDGED)
def test_the_flights_that_judge_are_in_no_part(tmp_path, data, date):
    """Two dates are kept apart for judging, in training and in calibration alike."""
    write_hit(tmp_path / "hit_uav", [date] * 3)
    write_yolo(tmp_path / "kit_ais", {})
    write_yolo(tmp_path / "cats_madison", {})
    assert fill_real(tmp_path / "pool", tmp_path) == []
    assert list(held_out_pictures(tmp_path)) == []


def test_classes_become_those_of_the_network(pool):
    """A minibus would be taught as a car, a bicycle as a truck."""
    whole = next(picture for picture in of_kind(pool, "kit") if len(picture.class_ids) == 4)
    assert whole.class_ids.tolist() == [ID["car"], ID["truck"], ID["bus"], ID["van"]]
    assert whole.boxes_px[2] == pytest.approx([300, 200, 340, 220], abs=0.01)
    for picture in of_kind(pool, "thermal"):
        assert picture.class_ids.tolist() == [ID["pedestrian"], ID["car"], ID["bicycle"], LARGE_VEHICLE, -1]
        assert picture.boxes_px[1].tolist() == [140, 100, 180, 124]
        assert (picture.visible == 1).all()


def test_held_out_pictures_are_enlarged_to_the_base_with_their_boxes(data):
    """Scores would be fitted to objects of another size than in flight."""
    thermal = list(held_out_pictures(data))[1]
    scale = 720 / 512
    assert thermal.boxes_px[0] == pytest.approx(np.array([20, 100, 60, 124]) * scale)
    assert thermal.ignored_px == pytest.approx(np.array([[500, 100, 540, 124]]) * scale)
    assert thermal.judged == {"car", "van", "truck", "bus", "pedestrian", "bicycle"}
    assert np.all(thermal.image_bgr[round(112 * scale), round(40 * scale)] > 200)


def test_madison_has_vehicles_our_marks_of_people_and_a_border_that_says_nothing(pool):
    """Vehicles that the border cuts are not labelled there: they would be taught as ground."""
    pictures = of_kind(pool, "road")
    assert len(pictures) == 2  # 99_99 was not marked: whoever walks there would be taught as ground
    without, with_people = sorted(pictures, key=lambda picture: len(picture.class_ids))
    assert without.class_ids.tolist() == [ID["car"], LARGE_VEHICLE, -1, -1, -1, -1]
    assert with_people.class_ids.tolist().count(ID["pedestrian"]) == 4
    person = with_people.boxes_px[with_people.class_ids == ID["pedestrian"]][0]
    assert person == pytest.approx([314.6, 422.6, 345.7, 439.3], abs=0.01)
    border, wanted = np.zeros((2, 640, 640), bool)
    for x1, y1, x2, y2 in without.boxes_px[-4:].round().astype(int):
        border[y1:y2, x1:x2] = True
    wanted[:26] = wanted[-26:] = wanted[:, :26] = wanted[:, -26:] = True
    assert (border == wanted).all()


def test_of_a_field_all_but_the_marked_cars_is_ground(tmp_path, monkeypatch):
    """Stones were people and shadows of trees cars: only marks say what stands there, whatever size is kept."""
    monkeypatch.setattr("hvt_train.pictures.real.in_flight", lambda image, *_, **__: image)
    write_hit(tmp_path / "hit_uav", [])
    folder = tmp_path / "field"
    folder.mkdir()
    for name in ("DJI_0024.JPG", "nothing.jpg"):
        cv2.imwrite(str(folder / name), np.full((3000, 4000, 3), 90, np.uint8))
    marked, empty = (read_picture(path) for path in fill_real(tmp_path / "pool", tmp_path))
    assert marked.image_bgr.shape[1] == 1600
    assert marked.class_ids.tolist() == [ID["car"], -1]
    assert marked.boxes_px[0] == pytest.approx([3111 * 0.4, 130 * 0.4, 3286 * 0.4, 273 * 0.4])
    assert len(empty.boxes_px) == 0


def test_the_pool_gives_views_of_each_set(pool):
    """A set would be read and never shown."""
    source = ViewSource([path for path, _ in pool.values()], seed=1, settings=ViewSettings(side=128))
    kinds = {int(kind) for _ in range(60) for kind in source.next().class_ids}
    assert {ID["car"], ID["pedestrian"], LARGE_VEHICLE, -1} <= kinds


class Claims:
    """Finds boxes of known scores, of which a known share is right; judged classes are car and person."""

    class_names = ("car", "person", "boat")

    def __init__(self, slope: float, shift: float, *, pictures: int) -> None:
        rng = np.random.default_rng(3)
        self.held_out, self.found = [], {}
        for number in range(pictures):
            scores = rng.uniform(0.02, 0.98, 20).astype(np.float32)
            true = 1 / (1 + np.exp(-(slope * np.log(scores / (1 - scores)) + shift)))
            left = np.arange(20) * 30.0
            boxes = np.stack([left, left * 0, left + 20, left * 0 + 20], 1).astype(np.float32)
            right = rng.random(20) < true
            image = np.full((4, 4, 3), number % 256, np.uint8)
            image[0, 0] = number // 256
            nothing, judged = np.zeros((0, 4), np.float32), frozenset({"car", "person"})
            self.held_out.append(HeldOut(image, boxes[right], nothing, judged))
            self.found[image.tobytes()] = Detections(boxes, scores, np.zeros(20, np.int32))

    def detect(self, image_bgr):
        return self.found[image_bgr.tobytes()]


def error(scores, right):
    """Expected calibration error over ten bins."""
    which = np.minimum((scores * 10).astype(int), 9)
    return sum(
        abs(scores[which == number].mean() - right[which == number].mean()) * (which == number).mean()
        for number in set(which.tolist())
    )


@pytest.mark.parametrize(("slope", "shift"), [(0.6, -1.2), (1.8, 0.5)])
def test_a_known_line_is_found_and_scores_become_true(slope, shift):
    """A box of .9 would be right half of the time, and a still would confirm it."""
    claims = Claims(slope, shift, pictures=200)
    found = fit_calibration(claims, claims.held_out)
    assert (found.slope, found.shift) == pytest.approx((slope, shift), abs=0.12)
    scores = np.concatenate([one.confidences for one in claims.found.values()])
    pairs = zip(claims.found.values(), claims.held_out, strict=True)
    right = np.concatenate([np.isin(one.boxes_xyxy_px[:, 0], kept.boxes_px[:, 0]) for one, kept in pairs])
    fitted = 1 / (1 + np.exp(-(found.slope * np.log(scores / (1 - scores)) + found.shift)))
    assert error(fitted, right) < 0.03
    assert error(fitted, right) < error(scores, right) / 3
    assert 0.1 <= found.confidence <= 0.8


def test_what_is_not_labelled_counts_neither_way():
    """Boats that a set does not label, and what lies on ignored ground, would pull every score down."""
    claims = Claims(1.0, 0.0, pictures=100)
    plain = fit_calibration(claims, claims.held_out)
    beside = np.array([[0, 100, 20, 120]], np.float32)
    for key, one in claims.found.items():
        boxes = np.concatenate([one.boxes_xyxy_px, beside, beside])
        sure = np.concatenate([one.confidences, np.array([0.95, 0.95], np.float32)])
        claims.found[key] = Detections(boxes, sure, np.array([*one.class_ids, 2, 0], np.int32))
    held_out = [HeldOut(one.image_bgr, one.boxes_px, beside, one.judged) for one in claims.held_out]
    assert fit_calibration(claims, held_out) == plain
