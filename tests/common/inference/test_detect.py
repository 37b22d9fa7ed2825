"""Detectors: heads, letterbox, suppression, names."""

import tracemalloc

import cv2
import numpy as np
import onnxruntime as ort
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_common.errors import UserError
from hvt_common.inference.detect import OnnxDetector, detect_every, detect_still_every, open_detector
from hvt_common.inference.heads.contract import YoloxCells
from hvt_common.inference.letterbox import Letterbox, Letterboxer, Preparation, as_bgr, without_palette
from hvt_common.inference.nms import MAX_CANDIDATES, MAX_DETECTIONS, suppress
from hvt_common.inference.runtimes.model import open_model
from hvt_common.values import Image
from hvt_models.exports.forms import Dense, Listed, PerQuery
from media.head_models import family_model
from media.onnx_models import (
    STRIDES,
    cells,
    colour_classifier,
    colour_detector,
    constant_model,
    scaling_inside,
)

RGB = str({0: "red", 1: "green", 2: "blue"})
OURS = {"hvt.training_commit": "1a2b3c4"}


def iou(first, second):
    """(N, M) overlaps, written apart from the code under test."""
    result = np.zeros((len(first), len(second)))
    for i, a in enumerate(np.asarray(first, float)):
        for j, b in enumerate(np.asarray(second, float)):
            width = max(0.0, min(a[2], b[2]) - max(a[0], b[0]))
            height = max(0.0, min(a[3], b[3]) - max(a[1], b[1]))
            union = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - width * height
            result[i, j] = width * height / union if union else 0.0
    return result


def empty(rows, columns):
    return np.zeros((1, rows, columns), np.float32)


def dense(columns):
    """What an Ultralytics network of two classes answers: these columns, and nothing in the others."""
    table = empty(4 + 2, 84)
    for place, column in columns.items():
        table[0, :, place] = column
    return table


def answering(folder, table, *, metadata=None, **settings):
    """A detector whose network answers each picture with the table."""
    return open_detector(str(constant_model(folder / "m.onnx", table, metadata=metadata)), **settings)


def found_in(folder, table, **settings):
    return answering(folder, table, **settings).detect(np.zeros((64, 64, 3), np.uint8))


# --- heads ---------------------------------------------------------------------------------------------------------


def test_yolox_boxes_come_out_exactly(tmp_path):
    """Every box of the most permissive detector family would be somewhere else; decoded twice, as large as all."""
    raw, decoded, grid = empty(84, 5 + 3), empty(84, 6), cells((64, 64))
    row = int(np.flatnonzero((grid == (2, 1, 16)).all(axis=1))[0])
    raw[0, row] = [0.25, 0.5, np.log(2), np.log(1.5), 0.8, 0.1, 0.9, 0.2]
    detector = answering(tmp_path, raw, confidence=0.5)
    assert detector.class_names == ("class 0", "class 1", "class 2")
    found = detector.detect(np.zeros((64, 64, 3), np.uint8))
    assert found.class_ids.tolist() == [1]
    np.testing.assert_allclose(found.confidences, [0.72], rtol=1e-5)
    np.testing.assert_allclose(found.boxes_xyxy_px, [[36 - 16, 24 - 12, 36 + 16, 24 + 12]], rtol=1e-5)
    decoded[0, :, :2] = (grid[:, :2] + 0.5) * grid[:, 2:]
    decoded[0, :, 2:4] = 10
    decoded[0, 20, :6] = [30, 20, 12, 8, 0.9, 1.0]
    found = found_in(tmp_path, decoded, metadata={"names": "['boat']"})
    np.testing.assert_allclose(found.boxes_xyxy_px, [[24, 16, 36, 24]], rtol=1e-5)


def test_ultralytics_boxes_come_out_exactly_and_suppressed_by_class(tmp_path):
    """One car would count as five, a person before a car vanish, or a van be a car and a van in every list."""
    several = {3: [30, 20, 20, 10, 0.3, 0.7], 9: [34, 20, 20, 10, 0, 0.8], 60: [30, 20, 20, 10, 0.9, 0.1]}
    found = found_in(
        tmp_path, dense(several | {70: [50, 50, 10, 10, 0.1, 0.26], 71: [50, 20, 10, 10, 0.1, 0.24]})
    )
    np.testing.assert_allclose(found.confidences, [0.9, 0.8, 0.26], rtol=1e-5)
    assert found.class_ids.tolist() == [0, 1, 1]
    np.testing.assert_allclose(found.boxes_xyxy_px, [[20, 15, 40, 25], [24, 15, 44, 25], [45, 45, 55, 55]])
    twice = dense({3: [30, 20, 20, 10, 0.7, 0.0], 9: [31, 20, 20, 10, 0.0, 0.8]})
    assert found_in(tmp_path, twice).class_ids.tolist() == [1]


def test_broken_numbers_never_become_detections(tmp_path):
    """One NaN would poison the tracker for the rest of the flight."""
    head = YoloxCells(STRIDES)
    bad = empty(84, 6)
    bad[0, :, 4:] = 0.9
    bad[0, ::4, 0] = np.nan
    bad[0, 1::4, 2] = np.inf
    bad[0, 2::4, 5] = np.nan
    bad[0, 3::8, 4] = np.inf
    good = head([bad], confidence=0.25, input_size=(64, 64))
    assert np.isfinite(good.boxes_input_px).all()
    assert len(good.scores) < 42
    columns = empty(5, 84)
    columns[0, 4] = np.nan
    assert len(Dense(transposed=True)([columns], confidence=0.25, input_size=(64, 64)).scores) == 0
    queries = PerQuery("corners", logits=True)(
        [
            np.tile([0.0, 0, 1, 1], (1, 2, 1)).astype(np.float32),
            np.array([[[np.inf, -np.inf], [3, -np.inf]]]),
        ],
        confidence=0.25,
        input_size=(64, 64),
    )
    assert (len(queries.scores), queries.wrong) == (1, "")
    rows = empty(9, 6)
    rows[0, :, 2:] = [5, 5, 0.9, np.nan]
    assert len(Listed(0, 4, 5)([rows], confidence=0.25, input_size=(64, 64)).scores) == 0


def test_a_picture_that_gives_no_number_is_none_without_objects(tmp_path):
    """Half precision overflows on some pictures: the ground would say that nothing is there."""
    path = colour_detector(tmp_path / "m.onnx", "ultralytics", size=(96, 64))
    detector = open_detector(str(scaling_inside(path, [("Mul", -1), ("Add", 0.97), ("Sqrt", None)])))
    assert len(detector.detect(np.full((64, 96, 3), 240, np.uint8))) == 0
    with pytest.raises(UserError, match=r"m\.onnx answers a picture with what is no number"):
        detector.detect(np.full((64, 96, 3), 255, np.uint8))


# --- letterbox -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("head", ["yolox", "ultralytics"])
@pytest.mark.parametrize("shape", [(48, 128), (200, 64), (96, 96), (311, 517), (31, 64)])
def test_a_coloured_square_is_found_where_it_is(tmp_path, head, shape):
    """Boxes would be shifted or stretched on every image that is not square, or red and blue swapped."""
    size = (96, 64)
    path = colour_detector(tmp_path / "m.onnx", head, size=size)
    detector = open_detector(str(path), confidence=0.9)
    letterbox = Letterbox.fitted(
        (shape[1], shape[0]), size, anchor="top-left" if head == "yolox" else "centre"
    )
    left, top, width, height = letterbox.content
    # The cell of stride 8 that lies wholly on the image, around its middle, and where that is on the image.
    cell = np.array([(left + width // 2) // 8 * 8, (top + height // 2) // 8 * 8])
    scale = np.array([shape[1] / width, shape[0] / height])
    low, high = (cell - (left, top)) * scale, (cell + 8 - (left, top)) * scale
    for channel in range(3):
        image = np.full((*shape, 3), 60, np.uint8)
        image[max(0, int(low[1] - 2)) : int(high[1] + 3), max(0, int(low[0] - 2)) : int(high[0] + 3)] = 0
        image[
            max(0, int(low[1] - 2)) : int(high[1] + 3), max(0, int(low[0] - 2)) : int(high[0] + 3), channel
        ] = 255
        found = detector.detect(image)
        expected = np.clip([*low, *high], 0, [shape[1], shape[0]] * 2)
        best = iou(found.boxes_xyxy_px, expected[None]).ravel()
        assert best.max() > 0.99
        # YOLOX networks see BGR as it is; Ultralytics networks see RGB.
        assert found.class_ids[best.argmax()] == (channel if head == "yolox" else 2 - channel)


def test_a_picture_that_fits_is_not_copied_whole():
    """A 1080p picture took 6 MB more for as long as the detector was there."""
    preparation = Preparation(mean=(0.0,) * 3, scale=(1.0,) * 3)
    boxer = Letterboxer(anchor="top-left", preparation=preparation, dtype=np.dtype(np.float32))
    picture = np.zeros((1000, 256, 3), np.uint8)
    tracemalloc.start()
    try:
        tensor, _ = boxer.fill(picture, (256, 1024))
        held = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert held < tensor.nbytes + picture.nbytes / 2


def test_a_thermal_palette_is_shown_in_grey():
    """Under "iron" hardly a person was found, for .65 of them in the same pictures in grey."""
    rng = np.random.default_rng(5)
    heat = cv2.GaussianBlur(rng.integers(0, 256, (240, 320), np.uint8), (0, 0), 6)
    heat = np.asarray(cv2.normalize(heat, heat, 20, 235, cv2.NORM_MINMAX), np.uint8)
    for palette in (cv2.COLORMAP_INFERNO, cv2.COLORMAP_HOT, cv2.COLORMAP_PLASMA):
        _, coded = cv2.imencode(".jpg", cv2.applyColorMap(heat, palette), [cv2.IMWRITE_JPEG_QUALITY, 85])
        shown, is_grey = without_palette(np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8))
        assert is_grey
        assert np.ptp(shown, axis=2).max() == 0
        assert np.corrcoef(shown[:, :, 0].ravel(), heat.ravel())[0, 1] > 0.9
    grey: Image = np.repeat(heat[:, :, None], 3, axis=2)
    shades = np.stack([np.roll(heat, 40 * by, axis=1) for by in range(3)], axis=2)
    photographs: list[Image] = [shades, grey // np.array([4, 2, 1], np.uint8)]
    for image in (grey, *photographs):
        shown, is_grey = without_palette(image)
        assert shown is image
        assert is_grey == (image is grey)


def test_the_border_is_grey_114():
    """Networks would see an edge around every picture that they were not trained on."""
    preparation = Preparation(mean=(0.0,) * 3, scale=(1 / 255,) * 3)
    boxer = Letterboxer(anchor="centre", preparation=preparation, dtype=np.dtype(np.float32))
    tensor, letterbox = boxer.fill(np.full((10, 40, 3), (10, 20, 30), np.uint8), (64, 32))
    assert letterbox.content == (0, 8, 64, 16)
    np.testing.assert_allclose(tensor[0, :, 0, 0], np.float32(114 / 255), rtol=1e-6)
    np.testing.assert_allclose(tensor[0, :, 16, 30], np.array([30, 20, 10]) / 255, rtol=1e-6)
    other, _ = boxer.fill(np.full((40, 10, 3), 255, np.uint8), (64, 32))
    assert other[0, 0, 16, 32] == 1
    np.testing.assert_allclose(other[0, 0, 16, 2], 114 / 255, rtol=1e-6)


@given(
    image=st.tuples(st.integers(1, 5000), st.integers(1, 5000)),
    tiles=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    anchor=st.sampled_from(["top-left", "centre"]),
)
def test_the_letterbox_holds_the_image_and_maps_back(image, tiles, anchor):
    """A panorama or a sliver would crash the detector or lose its boxes."""
    size = (tiles[0] * 32, tiles[1] * 32)
    letterbox = Letterbox.fitted(image, size, anchor=anchor)
    left, top, w, h = letterbox.content
    assert 0 <= left < left + w <= size[0]
    assert 0 <= top < top + h <= size[1]
    whole = letterbox.to_image(np.array([[left, top, left + w, top + h], [-9e9, -9e9, 9e9, 9e9]], np.float32))
    np.testing.assert_allclose(whole, [[0, 0, *image]] * 2, rtol=1e-5)


@pytest.mark.parametrize(
    "shape", [(1, 1, 3), (1, 1), (7, 500, 3), (500, 3, 3), (40, 40), (40, 40, 1), (40, 40, 4)]
)
@pytest.mark.parametrize("size", [(64, 64), None])
def test_odd_images_do_not_crash(tmp_path, shape, size):
    """A thermal camera, or a broken frame, would end the process."""
    detector = open_detector(str(colour_detector(tmp_path / "m.onnx", "yolox", size=size)), confidence=0.45)
    found = detector.detect(np.full(shape, 255, np.uint8))
    assert len(found) >= 1
    assert (found.boxes_xyxy_px[:, 2:] <= (shape[1], shape[0])).all()
    assert (found.boxes_xyxy_px[:, :2] >= 0).all()
    assert (np.diff(found.confidences) <= 0).all()


def test_what_is_no_image_is_a_bug():
    """An empty crop would be stretched into a phantom."""
    for shape, kind in (((0, 4, 3), np.uint8), ((4, 4, 3), np.float32), ((4, 4, 2), np.uint8)):
        with pytest.raises(ValueError, match="image"):
            as_bgr(np.zeros(shape, kind))


# --- suppression ---------------------------------------------------------------------------------------------------


def plain_suppression(boxes, scores, classes, limit):
    kept: list[int] = []
    for i in sorted(range(len(scores)), key=lambda i: (-scores[i], i)):
        if all(
            classes[i] != classes[j] or iou(boxes[i : i + 1], boxes[j : j + 1])[0, 0] <= limit for j in kept
        ):
            kept.append(i)
    return kept


@given(seed=st.integers(0, 10_000), count=st.integers(0, 40))
def test_suppression_keeps_what_the_definition_keeps(seed, count):
    """Neighbouring cars would hide each other, or one car be seen twice."""
    rng = np.random.default_rng(seed)
    centres, sides = rng.uniform(0, 60, (count, 2)), rng.uniform(5, 40, (count, 2))
    boxes = np.concatenate([centres - sides / 2, centres + sides / 2], axis=1).astype(np.float32)
    scores = (rng.integers(1, 12, count) / 12).astype(np.float32)  # with ties
    classes = rng.integers(0, 3, count).astype(np.int32)
    kept = plain_suppression(boxes, scores, classes, 0.45)
    assert suppress(boxes, scores, classes, iou=0.45).tolist() == kept
    assert suppress(boxes, scores, classes, iou=0.45, limit=2).tolist() == kept[:2]


def test_a_box_of_our_networks_is_the_mean_of_what_several_cells_say(tmp_path):
    """Boxes would jump where one cell after the other is the surest, and stand half beside small cars.

    Neighbours that both stay have boxes of their own.
    """
    table = dense(
        {
            3: [30, 20, 20, 10, 0.8, 0.0],
            9: [32, 21, 20, 10, 0.4, 0.0],
            10: [36, 20, 20, 10, 0.7, 0.0],  # it is suppressed, and shares too little to be heard
            11: [30, 22, 20, 10, 0.0, 0.6],  # another kind of object
        }
    )
    mean = np.array([20, 15, 40, 25]) + np.array([2, 1, 2, 1]) * 0.4 / 1.2
    for metadata, first in ((OURS, mean), ({}, np.floor(mean))):
        found = found_in(tmp_path, table, metadata=metadata)
        np.testing.assert_allclose(found.boxes_xyxy_px, np.stack([first, [20, 17, 40, 27]]), rtol=1e-5)
        np.testing.assert_allclose(found.confidences, [0.8, 0.6], rtol=1e-5)
    two = dense({3: [30, 20, 20, 10, 0.8, 0.0], 9: [34.5, 20, 20, 10, 0.7, 0.0]})
    found = found_in(tmp_path, two, metadata=OURS, nms_iou=0.7)
    apart = np.array([[20, 15, 40, 25], [24.5, 15, 44.5, 25]])
    np.testing.assert_allclose(found.boxes_xyxy_px, apart, rtol=1e-5)


def test_what_both_networks_of_a_file_see_is_surer(tmp_path):
    """A file of two networks would find no more than one of them."""
    grid = cells((64, 64), (8, 16, 32, 16, 32, 64))
    own, their = 84 - 20, 84
    assert grid[[own, their]].tolist() == [[0, 0, 16]] * 2
    raised = 0.35 / (0.35 + 0.65 * np.exp(-0.5))
    for first, second, expected in (
        ((own, 0.35), (their, 0.2), [raised]),
        ((their, 0.35), (own, 0.2), [raised]),
        ((own, 0.35), (their, 0.08), []),
        ((own, 0.35), (own + 1, 0.2), []),
    ):
        table = empty(len(grid), 7)
        for row, score in (first, second):
            x, y, stride = grid[row]
            size = np.log([20 / stride, 10 / stride])
            table[0, row] = [20 / stride - x, 20 / stride - y, *size, score, 1, 0]
        found = found_in(tmp_path, table, metadata=OURS, confidence=0.4)
        np.testing.assert_allclose(found.confidences, expected, rtol=1e-5)


def test_crowds_survive_up_to_the_cap():
    """A crowd of people or a full car park would be thinned out."""
    x, y = np.meshgrid(np.arange(50.0), np.arange(40.0))
    boxes = np.stack([x, y, x + 0.9, y + 0.9], axis=-1).reshape(-1, 4).astype(np.float32) * 20
    scores, kinds = np.linspace(1, 0.3, len(boxes), dtype=np.float32), np.zeros(7200, np.int32)
    crowd = np.repeat(np.arange(600), 12)
    assert suppress(boxes[crowd], scores[crowd], kinds, iou=0.45).tolist() == [*range(0, 7200, 12)]
    assert len(suppress(boxes, scores, kinds[: len(boxes)], iou=0.45)) == MAX_DETECTIONS
    assert len(suppress(boxes, scores, kinds[: len(boxes)], iou=0.45, limit=7)) == 7


def test_a_picture_full_of_boxes_costs_no_more_than_what_is_returned(monkeypatch):
    """Of a view that it does not know a network's 8192 boxes took three seconds a picture."""
    compared: list[int] = []
    chosen = cv2.dnn.NMSBoxes

    def counted(rects, *settings):
        compared.append(len(rects))
        return chosen(rects, *settings)

    monkeypatch.setattr(cv2.dnn, "NMSBoxes", counted)
    places = np.arange(3.0 * MAX_CANDIDATES).reshape(-1, 1)
    boxes = np.hstack([places, places, places + 0.5, places + 0.5]).astype(np.float32)
    kinds = np.zeros(len(boxes), np.int32)
    kept = suppress(boxes, np.ones(len(boxes), np.float32), kinds, iou=0.45, any_class_iou=0.8)
    assert kept.tolist() == list(range(MAX_DETECTIONS))
    assert sum(compared) <= 4 * MAX_DETECTIONS


# --- opening -------------------------------------------------------------------------------------------------------


def test_a_free_input_takes_the_size_of_the_image_or_of_the_user(tmp_path):
    """Small objects would be shrunk away, or a panorama would take all memory."""
    path = colour_detector(tmp_path / "m.onnx", "yolox", size=None)
    free = OnnxDetector(open_model(path))
    wanted = {(1280, 720): (1280, 736), (1, 1): (32, 32), (416, 416): (416, 416), (1921, 1): (1920, 32)}
    wanted |= {(3840, 2160): (1920, 1088)}
    assert {size: free.input_size(size) for size in wanted} == wanted
    assert OnnxDetector(open_model(path), size=(416, 320)).input_size((1280, 720)) == (416, 320)


def test_a_network_for_small_objects_has_small_images_enlarged(tmp_path, monkeypatch):
    """A car of a 640x360 base is six pixels long, within one cell; a thermal camera's people grow too large.

    Half of these are surer where a second look, at another size, shows them too: the file's second network is silent.
    """
    metadata = {"hvt.enlarge_to": "1280", "hvt.training_commit": "1a2b3c4"}
    path = colour_detector(tmp_path / "m.onnx", "yolox", size=None, metadata=metadata)
    detector = OnnxDetector(open_model(path), confidence=0.4)
    wanted = {(640, 512): (1280, 1024), (854, 480): (1280, 736), (1280, 720): (1280, 736)}
    wanted |= {(1920, 1080): (1920, 1088), (320, 240): (640, 480)}
    assert {size: detector.input_size(size) for size in wanted} == wanted
    hot = {(640, 512): (832, 672), (854, 480): (864, 480), (1280, 720): (1280, 736)}
    assert {size: detector.input_size(size, thermal=True) for size in hot} == hot
    inputs: list[tuple[int, ...]] = []
    run = detector.model.run
    monkeypatch.setattr(detector.model, "run", lambda *given: inputs.append(given[0].shape) or run(*given))
    thermal, coloured = (detector.detect(np.full((512, 640, 3), (90, 90, red), np.uint8)) for red in (90, 92))
    assert inputs == [(1, 3, 672, 832), (1, 3, 512, 640), (1, 3, 1024, 1280)]
    assert len(thermal) > len(coloured) == 0, "90 of 255 is .35, and agreed .47"
    image = np.zeros((64, 96, 3), np.uint8)
    image[16:24, 40:48] = (0, 255, 0)
    found = open_detector(str(path), confidence=0.9).detect(image)
    np.testing.assert_allclose(found.boxes_xyxy_px[:1], [[40, 16, 44, 20]], atol=0.05)
    for text in ("big", "-1", "1921", "1" * 9000):
        path = colour_detector(tmp_path / "m.onnx", "yolox", size=None, metadata={"hvt.enlarge_to": text})
        with pytest.raises(UserError, match="a whole number up to 1920"):
            open_detector(str(path))


def test_names_come_from_file_then_metadata_and_never_from_a_number(tmp_path):
    """Overlays would show numbers, or wrong words."""
    named = str(colour_detector(tmp_path / "a.onnx", "ultralytics", metadata={"names": RGB}))
    assert open_detector(named).class_names == ("red", "green", "blue")
    labels = tmp_path / "labels.txt"
    labels.write_text("one\ntwo\nthree\n")
    assert open_detector(named, labels=labels).class_names == ("one", "two", "three")
    for classes in (80, 10):
        path = constant_model(tmp_path / "b.onnx", empty(4 + classes, 126), size=(96, 64))
        assert open_detector(str(path)).class_names == tuple(f"class {index}" for index in range(classes))
    labels.write_text("one\ntwo\n")
    with pytest.raises(UserError, match=r"labels\.txt has 2 class names; .* has 3 classes"):
        open_detector(named, labels=labels)
    wrong = colour_detector(tmp_path / "c.onnx", "ultralytics", metadata={"names": "['a']"})
    with pytest.raises(UserError, match=r"metadata of .* has 1 class names"):
        open_detector(str(wrong))


def test_what_is_no_detector_is_refused_in_one_sentence(tmp_path):
    """A classifier given by mistake would fly and see nothing."""
    scores = empty(7, 84)
    models = {
        "classifier": colour_classifier(tmp_path / "c.onnx", batch=1, classes=1000),
        "wrong anchors": constant_model(tmp_path / "w.onnx", empty(8, 100)),
        "two heads": constant_model(tmp_path / "t.onnx", scores, empty(9, 84)),
        "logits": constant_model(tmp_path / "l.onnx", scores - 5),
        "masks": constant_model(tmp_path / "s.onnx", scores, metadata={"task": "segment"}),
        "8 bits": constant_model(tmp_path / "q.onnx", scores, dtype=np.uint8),  # each score was 0
    }
    for path in models.values():
        with pytest.raises(
            UserError, match=r"is not a detector .* accepted heads: yolox, yolox-decoded, "
        ) as caught:
            open_detector(str(path))
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match=r"outputs: scores \(1, 1000\) float32"):
        open_detector(str(models["classifier"]))
    with pytest.raises(
        UserError, match=r"detector 'yolo' is not known .*give one of motion, .*or an ONNX file"
    ):
        open_detector("yolo")
    with pytest.raises(UserError, match=r"detector 'y+' cannot be looked at"):  # a traceback
        open_detector("y" * 300)


@pytest.mark.parametrize(
    ("setting", "metadata", "words"),
    [
        ({"confidence": 1.5}, {}, r"confidence 1\.5"),
        ({"nms_iou": -0.1}, {}, r"NMS IoU -0\.1"),
        ({"size": (100, 64)}, {}, "100x64"),
        ({"size": (0, 64)}, {}, "0x64"),
        ({"size": (32, 64)}, {}, "32x64 does not fit"),
        ({}, {"hvt.scale": "0"}, "one number or three do, not 0"),
    ],
)
def test_settings_out_of_range_are_refused(tmp_path, setting, metadata, words):
    """A typo would give an empty flight."""
    path = colour_detector(tmp_path / "m.onnx", "yolox", metadata=metadata)
    with pytest.raises(UserError, match=words):
        open_detector(str(path), **setting)


# --- real models ---------------------------------------------------------------------------------------------------


def reference(path, image, *, confidence, size):
    """A straightforward decode after the models' own documentation, one candidate after the other."""
    session = ort.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    yolox = "yolox" in path.name
    height, width = image.shape[:2]
    ratio = min(size[0] / width, size[1] / height)
    new = (
        (int(width * ratio), int(height * ratio)) if yolox else (round(width * ratio), round(height * ratio))
    )
    left, top = (0, 0) if yolox else ((size[0] - new[0]) // 2, (size[1] - new[1]) // 2)
    canvas = np.full((size[1], size[0], 3), 114, np.float32)
    canvas[top : top + new[1], left : left + new[0]] = cv2.resize(image, new)
    tensor = canvas if yolox else canvas[..., ::-1] / np.float32(255)
    output = session.run(None, {"images": np.ascontiguousarray(tensor.transpose(2, 0, 1)[None])})[0][0]
    rows = []
    for row, (x, y, stride) in zip(output if yolox else output.T, cells(size), strict=True):
        scores = row[4] * row[5:] if yolox else row[4:]
        if scores.max() >= confidence:
            cx, cy, w, h = row[:4]
            if yolox:
                cx, cy, w, h = (cx + x) * stride, (cy + y) * stride, np.exp(w) * stride, np.exp(h) * stride
            box = np.array([cx - w / 2, cy - h / 2, cx + w / 2, cy + h / 2]) - [left, top, left, top]
            rows.append((np.clip(box / ratio, 0, [width, height] * 2), scores.max(), scores.argmax()))
    boxes, scores, classes = (np.array(column) for column in zip(*rows, strict=True))
    by_class = plain_suppression(boxes, scores, classes, 0.45)
    kept = plain_suppression(boxes[by_class], scores[by_class], np.zeros(len(by_class), int), 0.8)
    return [rows[by_class[i]] for i in kept]


def street(data):
    """The real aerial picture and its annotation file."""
    picture = data / "visdrone/0000001_02999_d_0000005.jpg"
    return cv2.imread(str(picture)), picture.with_suffix(".txt")


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("yolox_nano", (416, 416)),
        ("yolox_nano", (640, 384)),
        ("yolov5su_visdrone_640", (640, 640)),
        ("yolov5su_visdrone_736x1280", (1280, 736)),
    ],
)
def test_real_models_agree_with_a_plain_decode(data, name, size):
    """A subtle mistake of scale, order or colour would cost accuracy that nobody can explain."""
    path, (image, _) = data / f"models/{name}.onnx", street(data)
    found = open_detector(str(path), confidence=0.3, size=size).detect(image)
    expected = reference(path, image, confidence=0.3, size=size)
    assert len(found) == len(expected) >= 4
    np.testing.assert_allclose(found.confidences, [score for _, score, _ in expected], atol=2e-3)
    for box, score, class_id in expected:
        same = (np.abs(found.confidences - score) < 2e-3) & (found.class_ids == class_id)
        assert np.abs(found.boxes_xyxy_px[same] - box).max(axis=1).min() < 1.0


@pytest.mark.parametrize(("fps", "every"), [(0.5, 1), (2, 1), (5, 2), (10, 3), (15, 5), (60, 5)])
def test_the_detector_runs_three_times_a_second_where_frames_are_few(fps, every):
    """At two frames a second no object would overlap itself; at 60 the processor would be full.

    A still picture is looked at once a second.
    """
    assert (detect_every(None, fps=fps), detect_every(7, fps=fps)) == (every, 7)
    assert (detect_still_every(None, fps=15), detect_still_every(None, fps=0.5)) == (15, 1)
    assert (detect_still_every(7, fps=15), detect_still_every(7, fps=0.5)) == (7, 7)


@pytest.mark.parametrize("task", ["Detect", "object-detection", ""])
def test_a_detector_by_any_word_is_one(tmp_path, task):
    """Other exporters than Ultralytics name the task too; their models would be refused."""
    assert open_detector(
        str(family_model(tmp_path / "m.onnx", "yolov8", metadata={"task": task}))
    ).class_names
