"""The virtual camera over a still: its boxes must lie where the objects are."""

from itertools import islice

import cv2
import numpy as np
import pytest

from hvt_common.errors import UserError
from hvt_study.datasets.layouts.uri import open_dataset
from hvt_study.datasets.sequence import content_hash
from hvt_study.datasets.virtual_camera import USUAL_VIEW, VirtualCamera, open_camera, read_annotations

BOX = (300, 200, 40, 24)  # x, y, w, h of a white block


@pytest.fixture
def picture(tmp_path):
    """A dark picture with one white block, annotated as a car, one ignored region, and one of class "others"."""
    pixels = np.full((540, 960, 3), 40, np.uint8)
    x, y, w, h = BOX
    pixels[y : y + h, x : x + w] = 250
    path = tmp_path / "street.png"
    cv2.imwrite(str(path), pixels)
    path.with_suffix(".txt").write_text(
        f"{x},{y},{w},{h},1,4,0,0\n10,10,50,50,0,0,0,0\n500,300,20,20,1,11,0,0\n"
    )
    return path


@pytest.mark.parametrize("height", [USUAL_VIEW, 0.5, 2])
def test_boxes_follow_exactly(picture, height):
    """F1 at IoU 0.5 of small objects is lost by a pixel or two, in the mirrored land as in the picture."""
    camera = VirtualCamera(picture, height, fps=3, annotation_path=picture.with_suffix(".txt"))
    seen = 0
    for index, image in enumerate(camera.images()):
        labels = camera.labels(index)
        boxes, names = labels.boxes_xyxy_px, labels.class_names
        assert image.shape[1::-1] == camera.size
        if index % 6 or not len(boxes):
            continue
        ys, xs = np.nonzero(image[:, :, 0] > 145)
        assert set(names) == {"car"}
        for x1, y1, x2, y2 in boxes:
            near = (xs > x1 - 6) & (xs < x2 + 6) & (ys > y1 - 6) & (ys < y2 + 6)
            found = xs[near].min(), ys[near].min(), xs[near].max() + 1, ys[near].max() + 1
            assert np.allclose(found, (x1, y1, x2, y2), atol=1.01)
            seen += 1
    assert seen >= (1 if height == 0.5 else 6)


def test_it_moves_and_every_frame_has_noise_of_its_own(picture):
    """A picture that stands still would be coded for nothing, and every method would look good."""
    images = VirtualCamera(picture).images()
    first, second = next(images), next(images)
    assert (cv2.absdiff(first, second) > 0).mean() > 0.5
    assert next(VirtualCamera(picture).images()).tobytes() == first.tobytes()


def test_regions_without_labels_are_known(picture):
    """What VisDrone says nothing about must not count as a false alarm."""
    found, _ = read_annotations(picture.with_suffix(".txt"), (960, 540))
    assert found.class_names == ("car",)
    assert found.ignored_xyxy_px.tolist() == [[10, 10, 60, 60]]
    assert found.beside_xyxy_px.tolist() == [[500, 300, 520, 320]]  # a single object: boxes on it alone
    camera = VirtualCamera(picture, annotation_path=picture.with_suffix(".txt"))
    seen = [camera.labels(index) for index in range(0, 200, 20)]
    assert sum(len(one.ignored_xyxy_px) for one in seen) > 0
    assert sum(len(one.beside_xyxy_px) for one in seen) > 0


@pytest.mark.parametrize(
    ("name", "said"),
    [
        *(("no.png", "does not exist"), ("text.png", "not one of at least")),
        *((f"street.png@{height}", "give a number from") for height in ("0", "-1", "99", "nan", "high", "")),
    ],
)
def test_a_bad_picture_or_height_is_one_sentence(picture, name, said):
    """The file or the value is named, and what is accepted."""
    (picture.parent / "text.png").write_bytes(b"not a picture")
    with pytest.raises(UserError, match=said):
        open_camera(f"still:{picture.with_name(name)}", fps=15)


def test_a_bad_annotation_is_named_with_its_line(picture, caplog):
    """One bad line would end a whole set; a table of another layout would give nonsense."""
    picture.with_suffix(".txt").write_text("1,2,3,4,1,4,0,0\n1;2;3\n")
    VirtualCamera(picture, annotation_path=picture.with_suffix(".txt"))
    assert "1 of 2 lines are left out; the first:" in caplog.text
    assert "line 2 is '1;2;3'" in caplog.text
    picture.with_suffix(".txt").write_text("1;2;3\n")
    with pytest.raises(UserError, match="line 1"):
        VirtualCamera(picture, annotation_path=picture.with_suffix(".txt"))


def test_yolo_labels_lie_where_visdrones_do(picture):
    """Most aerial sets have YOLO's files: without them their pictures could be flown with reference labels only."""
    root = picture.parent
    for folder in ("images", "labels"):
        (root / folder).mkdir()
    moved = picture.rename(root / "images" / "street.png")
    x, y, w, h = BOX
    (root / "labels" / "street.txt").write_text(
        f"1 {(x + w / 2) / 960} {(y + h / 2) / 540} {w / 960} {h / 540}\n0 0.9 0.9 0.1 0.1\n"
    )
    with pytest.raises(UserError, match=r"no classes\.txt"):
        open_dataset(f"still:{root}")
    (sequence,) = open_dataset(f"still:{moved}?classes=dontcare,truck,person&view=0.9")
    found = sequence.labels(105)
    image = next(islice(open_camera(f"still:{moved}@0.9", fps=15).images(), 105, None))
    assert (sequence.class_set, set(found.class_names)) == (("person", "truck"), {"truck"})
    ys, xs = np.nonzero(image[:, :, 0] > 145)
    assert any(
        np.allclose(box, (xs.min(), ys.min(), xs.max() + 1, ys.max() + 1), atol=1.01)
        for box in found.boxes_xyxy_px
    )
    (turned,) = open_dataset(f"still:{moved}?classes=dontcare,person,truck&view=0.9")
    assert content_hash(turned) != content_hash(sequence), "the flight would have the labels of the other"
    for folder in ("images", "labels"):
        (root / folder).rename(root / folder.title())  # as other sets, in any case of their names
    (only,) = open_dataset(f"still:{root}?classes=dontcare,truck,person&labelled=vehicle")
    assert only.class_set == ("truck",)
    with pytest.raises(UserError, match="labels none of boat"):
        open_dataset(f"still:{root}?classes=dontcare,truck,person&labelled=boat")
