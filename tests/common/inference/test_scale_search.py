"""The scale is found: objects that are too small for the network are looked at enlarged, and large ones reduced."""

import logging

import cv2
import numpy as np
import pytest

from hvt_common.inference.scale_search import ScaleSearch
from hvt_common.values import Detections

SIZE = (640, 360)


def picture(count, side_px):
    image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    for number in range(count):
        x, y = 20 + 24 * (number % 25), 20 + 40 * (number // 25)
        image[y : y + side_px, x : x + side_px] = 255
    return image


class Squares:
    """A network that sees squares of 10 to 100 pixels, corners of larger ones; it counts its runs."""

    def __init__(self):
        self.runs = self.reduced = 0

    def detect(self, image):
        if max(image.shape) <= 256:
            self.reduced += 1
        else:
            self.runs += 1
        _, _, stats, _ = cv2.connectedComponentsWithStats((image[..., 0] > 127).astype(np.uint8))
        squares = [one[:4] if max(one[2:4]) <= 100 else (*one[:2], 12, 12) for one in stats[1:]]
        boxes = np.array([(x, y, x + w, y + h) for x, y, w, h in squares if min(w, h) >= 10], np.float32)
        count = len(boxes)
        return Detections(boxes.reshape(-1, 4), np.full(count, 0.8, np.float32), np.zeros(count, np.int32))


def flown(pictures, caplog):
    """How many objects each picture gave, the runs of each, and the search."""
    caplog.set_level(logging.INFO)
    network, found, runs = Squares(), [], []
    search = ScaleSearch(network.detect, confidence=0.4)
    for image in pictures:
        before = network.runs
        found.append(len(search.take(network.detect(image), image)))
        runs.append(network.runs - before)
    return found, runs, search


def test_small_objects_are_looked_at_enlarged_from_the_first_second_on(caplog):
    """Of a map-like view nothing but roofs and trees had a box."""
    small = picture(200, 5)
    found, runs, search = flown([small] * 5, caplog)
    assert found == [0, 0, 200, 200, 200]
    assert runs == [1, 2, 5, 5, 5], "what a picture takes, one probe, then the whole and its four parts"
    assert search.interval(5) == 15, "five runs as often as one would take the whole processor"
    (record,) = caplog.records
    assert "objects are small here" in record.getMessage()


@pytest.mark.parametrize(("side_px", "found"), [(200, 4), (400, 0)])
def test_what_the_whole_picture_would_show_is_not_taken_from_a_part_of_it(side_px, found):
    """Five stripes of a crossing, 104 pixels long, were a bus for two seconds: a part hides what is around them."""

    def detect(image):
        boxes = [[100, 100, 100 + side_px, 160]] if max(image.shape) > max(SIZE) else np.empty((0, 4))
        count = len(boxes)
        return Detections(np.array(boxes, np.float32), np.full(count, 0.8, np.float32), np.zeros(count, int))

    search = ScaleSearch(detect, confidence=0.4)
    search.enlarged = True
    assert len(search.take(Detections.none(), picture(0, 0))) == found


def test_boxes_lie_on_the_objects(caplog):
    """What is found in an enlarged part would be drawn at the enlarged place."""
    small, network = picture(200, 6), Squares()
    search = ScaleSearch(network.detect, confidence=0.4)
    for _ in range(3):
        boxes = search.take(Detections.none(), small).boxes_xyxy_px
    right = {(20 + 24 * (n % 25), 20 + 40 * (n // 25)) for n in range(200)}
    assert len(boxes) == 200
    for x1, y1, x2, y2 in boxes:
        assert min(abs(x1 - x) + abs(y1 - y) for x, y in right) < 2
        assert 4 < x2 - x1 < 8
        assert 4 < y2 - y1 < 8


def test_objects_of_the_usual_size_cost_a_probe_now_and_then(caplog):
    """Every flight would pay five runs for a few more boxes, half of them wrong."""
    found, runs, search = flown([picture(200, 12)] * 100, caplog)
    assert set(found) == {200}
    assert not search.enlarged
    assert sum(runs) <= 100 + 3 + 3
    assert [number for number, count in enumerate(runs[:20], 1) if count > 1] == [2, 5, 8]
    assert not caplog.records


def test_it_follows_the_scene(caplog):
    """After a cut the eye would stay at the scale of what was."""
    near, far, empty = picture(200, 12), picture(200, 5), picture(0, 5)
    found, _, search = flown([near] * 10 + [far] * 4, caplog)
    assert found[-2:] == [200, 200]
    assert search.enlarged
    found, runs, search = flown([far] * 10 + [near] * 4 + [far] * 3, caplog)
    assert found[10:14] == [200] * 4, "the objects are there at either scale"
    assert runs[12:14] == [5, 1], "three pictures in vain"
    assert found[-1] == 200
    found, runs, search = flown([far] * 10 + [empty] * 10, caplog)
    assert runs[-1] == 1
    assert not search.enlarged


def test_a_detector_that_fails_or_a_large_picture_changes_nothing(caplog):
    """A failing detector would have each picture searched in parts, or a picture in its own pixels be enlarged."""
    search = ScaleSearch(lambda _: None, confidence=0.4)
    assert len(search.take(Detections.none(), picture(200, 5))) == 0
    assert not search.enlarged
    large = cv2.resize(picture(200, 5), (1920, 1080), interpolation=cv2.INTER_NEAREST)
    assert flown([np.asarray(large, np.uint8)] * 5, caplog)[1] == [1] * 5


def test_a_large_object_is_found_reduced_and_its_parts_are_none(caplog):
    """A car that filled a third of the picture had no box, and its mirror was a pedestrian."""
    large, network = picture(0, 5), Squares()
    large[60:260, 200:400] = 255
    search = ScaleSearch(network.detect, confidence=0.4)
    found = [search.take(network.detect(large), large) for _ in range(12)]
    for one in found:
        np.testing.assert_allclose(one.boxes_xyxy_px, [[200, 60, 400, 260]], atol=2)
    assert network.reduced == 12
    assert len(search.take(Detections.none(), picture(0, 5))) == 0
    assert not search.enlarged


def test_without_large_objects_each_third_picture_is_looked_at_reduced_and_none_where_enough_are_sure(caplog):
    """A drone far above would pay for what is never there."""
    for count, reduced in ((4, 1 + 10), (5, 0)):
        near, network = picture(count, 12), Squares()
        search = ScaleSearch(network.detect, confidence=0.4)
        assert {len(search.take(network.detect(near), near)) for _ in range(30)} == {count}
        assert network.reduced == reduced
