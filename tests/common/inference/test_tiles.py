"""Tiles: small objects are seen larger, and what a border cuts is not counted twice."""

import cv2
import numpy as np
import pytest

from hvt_common.errors import UserError
from hvt_common.inference.detect import open_detector, warm_up
from hvt_common.inference.nms import suppress
from hvt_common.inference.tiles import MOST_RUNS, TiledDetector, auto_grid, parse_tiles, tile_boxes, tiled
from hvt_common.values import Detections, iou

MODEL = "yolov5su_visdrone_640.onnx"


class Blobs:
    """A network that sees white blobs, if they have enough pixels on its input of ``side``."""

    class_names = ("car", "truck")

    def __init__(self, side=320, *, least_px=10):
        self.side, self.least_px = side, least_px
        self.runs = 0

    def input_size(self, image_size):
        return self.side, self.side

    def detect(self, image_bgr):
        """Each blob with its own bounding box; the larger the surer, and cars are brighter."""
        self.runs += 1
        scale = self.side / max(image_bgr.shape[:2])
        _, _, stats, _ = cv2.connectedComponentsWithStats((image_bgr[..., 0] > 60).astype(np.uint8))
        found = [(x, y, x + w, y + h) for x, y, w, h, _ in stats[1:] if min(w, h) * scale >= self.least_px]
        boxes = np.array(found, np.float32).reshape(-1, 4)
        sizes = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
        sure = np.clip(0.3 + sizes / 1e5, 0, 1).astype(np.float32)
        bright = [image_bgr[int(y1) : int(y2), int(x1) : int(x2), 0].max() < 150 for x1, y1, x2, y2 in found]
        return Detections(boxes, sure, np.array(bright, np.int32).reshape(-1))


def picture(*boxes, size=(1280, 720), value=255):
    image = np.zeros((size[1], size[0], 3), np.uint8)
    for x1, y1, x2, y2 in boxes:
        image[y1:y2, x1:x2] = value
    return image


@pytest.mark.parametrize(
    ("size", "grid"), [((1280, 720), (2, 2)), ((1921, 1083), (5, 3)), ((100, 80), (1, 4)), ((64, 64), (1, 1))]
)
def test_tiles_cover_the_picture_and_overlap(size, grid):
    """An object in a gap would never be seen, or one on a border never whole."""
    shown, tiles = np.zeros((size[1], size[0]), int), tile_boxes(size, grid)
    assert len(tiles) == grid[0] * grid[1]
    assert len({(x2 - x1, y2 - y1) for x1, y1, x2, y2 in tiles}) == 1, "one shape, compiled once"
    for x1, y1, x2, y2 in tiles:
        assert min(x1, y1) >= 0
        shown[y1:y2, x1:x2] += 1
    assert shown.min() == 1
    assert grid[0] == 1 or tiles[0][2] - tiles[1][0] >= 0.09 * tiles[0][2]


def test_small_objects_are_found_on_tiles_only():
    """``--tiles`` would cost its runs and show nothing more."""
    image = picture((100, 100, 124, 124), (700, 500, 724, 524))
    assert len(Blobs().detect(image)) == 0
    found = TiledDetector(Blobs(), grid=(3, 2)).detect(image)
    assert sorted(map(tuple, found.boxes_xyxy_px.tolist())) == [(100, 100, 124, 124), (700, 500, 724, 524)]


def test_what_a_border_cuts_is_one_object():
    """A bus on a border would be two, and a person beside it be part of the bus."""
    boxes = [(0, 300, 90, 420), (500, 100, 800, 200), (630, 340, 650, 380), (1190, 600, 1280, 720)]
    found = TiledDetector(Blobs(least_px=4), grid=(2, 2)).detect(picture(*boxes))
    assert sorted(map(tuple, found.boxes_xyxy_px.tolist())) == boxes


def test_pieces_that_nothing_covers_are_put_together():
    """A large object that the whole picture did not show would be lost, or counted in halves."""

    class OnlyTiles(Blobs):
        def detect(self, image_bgr):
            return Detections.none() if image_bgr.shape[1] == 1280 else super().detect(image_bgr)

    found = TiledDetector(OnlyTiles(least_px=4), grid=(2, 1)).detect(picture((500, 100, 800, 200)))
    assert found.boxes_xyxy_px.tolist() == [[500, 100, 800, 200]], "two pieces put together"
    found = TiledDetector(OnlyTiles(least_px=4), grid=(2, 2)).detect(
        picture((500, 250, 800, 450), (610, 20, 900, 60))
    )
    assert sorted(found.boxes_xyxy_px.tolist()) == [[500, 250, 800, 450], [610, 20, 900, 60]], "four, and two"


def test_one_vehicle_is_not_a_car_and_a_truck():
    """Each car park would hold twice the vehicles, half of them trucks."""
    boxes = np.array([[10, 10, 50, 40], [11, 10, 50, 41], [80, 10, 120, 40], [100, 10, 140, 40]], np.float32)
    scores = np.array([0.5, 0.7, 0.6, 0.4], np.float32)
    classes = np.array([0, 1, 0, 1], np.int32)
    assert suppress(boxes, scores, classes, iou=0.45).tolist() == [1, 2, 0, 3]
    assert suppress(boxes, scores, classes, iou=0.45, any_class_iou=0.7).tolist() == [1, 2, 3]


def test_auto_follows_sizes_alone_and_stays_within_its_runs():
    """The same clip would give other tracks on another machine, or the processor melt on a large one."""
    assert auto_grid((1280, 720), Blobs(640)) == (2, 1)
    assert auto_grid((1920, 1080), Blobs(640)) == (3, 2)
    assert auto_grid((640, 360), Blobs(640)) == (1, 1), "already seen at full size"
    for size in ((3840, 2160), (8000, 500), (500, 8000), (64, 64)):
        network = Blobs(640)
        detector = TiledDetector(network, grid="auto")
        detector.detect(np.zeros((size[1], size[0], 3), np.uint8))
        columns, rows = detector.grid(size)
        assert network.runs == (1 if columns * rows == 1 else columns * rows + 1) <= MOST_RUNS


def test_nonsense_is_one_sentence():
    """The user would see a traceback."""
    for text in ("", "2", "2x", "0x2", "2x2x2", "-1x2", "9x9", "Auto", "2 x 2", "1e1x2"):
        with pytest.raises(UserError, match="off, auto, search or CxR such as 2x2"):
            parse_tiles(text)


def test_the_three_words_of_the_setting():
    """A setting would be accepted and change nothing; motion compares a picture with the one before."""
    network, motion = Blobs(), open_detector("motion")
    assert parse_tiles("4x3") == (4, 3)
    assert tiled(network, "off") is network
    two = tiled(network, "2x1")
    assert isinstance(two, TiledDetector)
    assert two.grid((99, 99)) == (2, 1)
    assert tiled(network, "auto").class_names == ("car", "truck")
    assert tiled(motion, "auto") is motion
    with pytest.raises(UserError, match="take whole pictures"):
        tiled(motion, "2x2")
    warm_up(tiled(network, "3x2"), (640, 360))
    assert network.runs == 7, "every shape once"
    warm_up(motion, (640, 360))


@pytest.mark.realdata
def test_on_real_small_objects_tiles_find_more(data):
    """The whole point: people and cars of a few pixels from high up."""
    image = cv2.imread(str(data / "visdrone" / "0000001_02999_d_0000005.jpg"))
    truth = np.loadtxt(data / "visdrone" / "0000001_02999_d_0000005.txt", delimiter=",")
    truth = truth[(truth[:, 5] > 0) & (truth[:, 5] < 11), :4]
    truth[:, 2:] += truth[:, :2]
    half = cv2.resize(image, (960, 540), interpolation=cv2.INTER_AREA)
    wide = np.tile(half, (1, 2, 1))
    truth = np.concatenate([truth / 2, truth / 2 + (960, 0, 960, 0)])
    whole = open_detector(str(data / "models" / MODEL))

    def recall(detector):
        return float((iou(detector.detect(wide).boxes_xyxy_px, truth).max(axis=0) > 0.5).mean())

    assert recall(tiled(whole, "auto")) > 3 * recall(whole) > 0.2
