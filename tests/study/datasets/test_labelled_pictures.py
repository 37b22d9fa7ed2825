"""Labelled pictures as tools write them: where labels lie, and rows and sizes that do not fit."""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from hvt_common.errors import UserError
from hvt_study.commands.detect import Finding, write_sheet
from hvt_study.datasets.label_files import read_class_file, read_image
from hvt_study.datasets.labelled_pictures import LabelledPicture, doubts_of, find_pictures
from hvt_study.datasets.labels import FrameLabels

SIZE = (200, 100)
BOX = [20.0, 10.0, 80.0, 60.0]
ROW = "1 0.25 0.35 0.3 0.5\n"
NAMES = ("car", "bus")


def picture(path: Path, size: tuple[int, int] = SIZE, *, exif: int | None = None) -> Path:
    """A grey picture of this (width, height)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    tags = Image.Exif()
    if exif is not None:
        tags[0x0112] = exif
    Image.fromarray(np.full((size[1], size[0], 3), 90, np.uint8)).save(path, exif=tags)
    return path


def text(path: Path, content: str, encoding: str = "utf-8") -> Path:
    """A file of text."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content.encode(encoding))
    return path


def voc(name: str = "bus", size: tuple[int, int] = SIZE) -> str:
    """As labelImg writes it."""
    x1, y1, x2, y2 = (int(side) for side in BOX)
    return (
        f"<annotation><size><width>{size[0]}</width><height>{size[1]}</height></size><object><name>{name}</name>"
        f"<bndbox><xmin>{x1}</xmin><ymin>{y1}</ymin><xmax>{x2}</xmax><ymax>{y2}</ymax></bndbox></object></annotation>"
    )


def coco(name: str = "a.jpg", box: object = None, **image: object) -> str:
    """One picture with one bus, and a second row where a box is given."""
    x1, y1, x2, y2 = BOX
    boxes = [[x1, y1, x2 - x1, y2 - y1], *([box] if box is not None else [])]
    return json.dumps(
        {
            "images": [{"id": 1, "file_name": name, **image}],
            "categories": [{"id": 5, "name": "bus"}],
            "annotations": [
                {"id": number, "image_id": 1, "category_id": 5, "bbox": one}
                for number, one in enumerate(boxes)
            ],
        }
    )


def read(place: Path) -> list[tuple[LabelledPicture, FrameLabels]]:
    """Every picture that can be read, with its labels."""
    found = []
    for one in find_pictures(place, classes=None):
        image = read_image(one.path, one.labelled_size)
        assert image is not None, one.unreadable
        labels = one.read((image.shape[1], image.shape[0]))
        assert labels is not None
        found.append((one, labels))
    return found


LAYOUTS: dict[str, tuple[str, dict[str, str | tuple[str, str]]]] = {
    "Ultralytics, with a list over several lines": (
        "images/train/a.jpg",
        {
            "labels/train/a.txt": ROW,
            "data.yaml": (
                "path: .\ntrain: images/train\nnames:\n  0: car\n  1: 'bus'  # large\nnc: 2\n",
                "utf-8-sig",
            ),
        },
    ),
    "Roboflow, a folder a split": (
        "train/images/a_jpg.rf.1.jpg",
        {
            "train/labels/a_jpg.rf.1.txt": ROW,
            "data.yaml": "train: ../train/images\nnc: 2\nnames: ['car', 'bus']\n",
        },
    ),
    "Roboflow, COCO": ("valid/a.jpg", {"valid/_annotations.coco.json": coco()}),
    "FiftyOne, YOLOv5Dataset": (
        "images/val/a.jpg",
        {"labels/val/a.txt": ROW, "dataset.yaml": "names:\n- car\n- bus\nnc: 2\n"},
    ),
    "FiftyOne, COCODetectionDataset": ("data/a.jpg", {"labels.json": coco()}),
    "labelImg": ("a.jpg", {"a.txt": ROW, "classes.txt": "car\nbus\n"}),
    "labelImg, VOC": ("a.jpg", {"a.xml": (voc(), "utf-8-sig")}),
    "CVAT, YOLO 1.1": ("obj_train_data/a.jpg", {"obj_train_data/a.txt": ROW, "obj.names": "car\nbus\n"}),
    "CVAT, COCO 1.0": ("images/a.jpg", {"annotations/instances_default.json": coco()}),
    "CVAT, PASCAL VOC 1.1": ("JPEGImages/a.jpg", {"Annotations/a.xml": voc()}),
    "Label Studio": ("images/a.jpg", {"labels/a.txt": ROW, "classes.txt": ("car\nbus\n", "utf-16")}),
    "Label Studio, COCO, from Windows": (
        "images/a.jpg",
        {"result.json": (coco("images\\a.jpg"), "utf-8-sig")},
    ),
}


def lay(root: Path, layout: str) -> None:
    """One picture and its labels, as that tool lays them."""
    shown, files = LAYOUTS[layout]
    picture(root / shown)
    for name, content in files.items():
        text(root / name, *(content if isinstance(content, tuple) else (content,)))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_layouts_of_tools_are_found(tmp_path: Path, layout: str) -> None:
    """Whoever labels with another tool would have to move a thousand files first."""
    lay(tmp_path, layout)
    ((one, labels),) = read(tmp_path)
    assert labels.class_names == ("bus",)
    np.testing.assert_allclose(labels.boxes_xyxy_px, [BOX], atol=0.01)
    assert doubts_of([one]) == []


def test_labels_that_nothing_finds_are_said_with_the_places(tmp_path: Path) -> None:
    """A set would be taken for one without labels, and no figure come out."""
    picture(tmp_path / "images/a.jpg")
    text(tmp_path / "labels/b.txt", ROW)
    with pytest.raises(
        UserError, match=r"has no label of any of its 1 pictures, such as a\.jpg: looked in labels/"
    ):
        find_pictures(tmp_path, classes=None)
    text(tmp_path / "labels/a.txt", ROW)
    with pytest.raises(UserError, match=r"no classes\.txt, obj\.names or data\.yaml"):
        find_pictures(tmp_path, classes=None)


def test_one_bad_row_costs_itself_alone(tmp_path: Path) -> None:
    """A side of 1.0005, which exporters write, ended the whole set."""
    lay(tmp_path, "labelImg")
    rows = [
        "0 0.25 0.50025 0.5 1.0005",
        "0 0.9 0.5 0.4 0.2",
        "9 0.5 0.5 0.1 0.1",
        "car",
        "0 3 0.5 0.1 0.1",
        "0 nan .5 .1 .1",
    ]
    text(tmp_path / "a.txt", "\n".join([*rows, ROW, "1 0.1 0.1 0.4 0.1 0.4 0.6 0.1 0.6"]))
    ((one, labels),) = read(tmp_path)
    assert labels.class_names == ("car", "car", "bus", "bus")
    np.testing.assert_allclose(
        labels.boxes_xyxy_px, [[0, 0, 100, 100], [140, 40, 200, 60], BOX, [20, 10, 80, 60]], atol=0.01
    )
    said = doubts_of([one])
    assert len(said) == 2
    assert "2 labels end outside their picture and were cut; the worst is" in said[0]
    assert "a.txt, line 2, by 20 px" in said[0]
    assert "4 labels were left out; the first: " in said[1]
    assert "a.txt, line 3 has class 9; there are 2, from 0" in said[1]


@pytest.mark.parametrize(
    ("box", "boxes", "words"),
    [
        ([-0.5, 10, 20, 20], [BOX, [0, 10, 19.5, 30]], "COCO annotation 1 of labels.json, by 0.5 px"),
        ([190, 90, 20, 20], [BOX, [190, 90, 200, 100]], "by 10 px"),
        ([500, 90, 20, 20], [BOX], "1 labels were left out; the first: COCO annotation 1"),
        ([1, 2, 3], [BOX], "has the box [1, 2, 3]"),
        ([float("nan"), 1, 2, 3], [BOX], "has the box [nan, 1, 2, 3]: it has no box of four numbers"),
        ([10**400, 1, 2, 3], [BOX], "has the box [1000"),
        ([5, 5, -2, 4], [BOX], "has a box outside the picture of 200x100, or without area"),
        ("none", [BOX], "has the box none: it has no box of four numbers"),
    ],
)
def test_boxes_of_coco_are_cut_at_the_picture(
    tmp_path: Path, box: list[float], boxes: list[list[float]], words: str
) -> None:
    """An x of -0.5, which annotators write, ended the whole set."""
    picture(tmp_path / "data/a.jpg")
    text(tmp_path / "labels.json", coco(box=box))
    ((one, labels),) = read(tmp_path / "labels.json")
    np.testing.assert_allclose(labels.boxes_xyxy_px, boxes, atol=1e-4)
    (said,) = doubts_of([one])
    assert words in said


def test_a_set_without_a_good_row_is_refused(tmp_path: Path) -> None:
    """Of labels in pixels nothing is right, and a recall of nothing would be said."""
    lay(tmp_path, "labelImg")
    text(tmp_path / "a.txt", "1 50 35 60 50\n")
    ((one, _),) = read(tmp_path)
    with pytest.raises(UserError, match=r"a\.txt, line 1 has a box outside the picture"):
        doubts_of([one])


def test_a_picture_that_was_labelled_as_it_lies_is_read_so(tmp_path: Path) -> None:
    """A phone's picture is turned by its EXIF tag, its labels are not: recall 0.0 without a word."""
    picture(tmp_path / "data/a.jpg", exif=6)
    text(tmp_path / "labels.json", coco(width=200, height=100))
    ((one, labels),) = read(tmp_path)
    image = read_image(one.path, one.labelled_size)
    assert image is not None
    assert image.shape == (100, 200, 3)
    write_sheet(tmp_path / "sheet.png", [Finding(one, [150, 20, 190, 60], "", 1.0)])
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet is not None
    assert sheet[75, 75].tolist() == [90, 90, 90], "and the place of a box is shown where it lies"
    np.testing.assert_allclose(labels.boxes_xyxy_px, [BOX])
    text(tmp_path / "labels.json", coco(width=100, height=200))  # labelled as it is shown
    ((one, _),) = read(tmp_path)
    image = read_image(one.path, one.labelled_size)
    assert image is not None
    assert image.shape == (200, 100, 3)


@pytest.mark.parametrize("width", [200, "200", 200.0, None])
def test_a_picture_that_was_resized_has_its_boxes_scaled(tmp_path: Path, width: object) -> None:
    """Boxes of the large picture on the small one: recall 0.0 without a word."""
    picture(tmp_path / "data/a.jpg", (100, 50))
    if width:
        text(tmp_path / "labels.json", coco(width=width, height=100))
    else:
        text(tmp_path / "data/a.xml", voc())
    ((one, labels),) = read(tmp_path)
    np.testing.assert_allclose(labels.boxes_xyxy_px, [np.array(BOX) / 2])
    (said,) = doubts_of([one])
    assert "1 pictures were resized since they were labelled" in said
    assert "is 100x50, and its labels say 200x100" in said
    picture(tmp_path / "data/a.jpg", (120, 120))
    with pytest.raises(UserError, match=r"a\.jpg is 120x120, and its labels say 200x100"):
        read(tmp_path)


def test_a_picture_that_is_not_there_is_called_so(tmp_path: Path) -> None:
    """A path that is wrong would be looked for among damaged files."""
    for name in (f"{'a' * 300}.jpg", "a.jpg"):
        text(tmp_path / "labels.json", coco(name))
        (one,) = find_pictures(tmp_path / "labels.json", classes=None)
        assert one.unreadable.endswith("a.jpg does not exist")
    text(one.path, "no picture")
    assert one.unreadable.endswith("a.jpg cannot be read as a picture")
    assert cv2.imread(str(one.path)) is None


@pytest.mark.parametrize(
    ("shown", "labels"),
    [
        *(("A.JPG", "A.TXT"), ("Images/a.jpg", "Labels/a.txt"), ("a.jpg", "a.jpg.txt"), ("a.JPEG", "A.XML")),
        ("\u00e9.jpg", "e\u0301.txt"),  # the second from macOS
    ],
)
def test_names_of_other_case_are_found(tmp_path: Path, shown: str, labels: str) -> None:
    """A set from Windows was taken for pictures that nobody labelled."""
    picture(tmp_path / shown)
    text(tmp_path / labels, voc() if labels.endswith("XML") else ROW)
    text(tmp_path / "classes.txt", "\n".join(NAMES))
    ((_, found),) = read(tmp_path)
    assert (found.class_names, found.boxes_xyxy_px.tolist()) == (("bus",), [BOX])


def test_the_folder_of_the_pictures_alone_has_its_labels(tmp_path: Path) -> None:
    """Ultralytics looks in labels/ beside images/, whatever folder it was given."""
    picture(tmp_path / "valid/images/a.jpg")
    text(tmp_path / "valid/labels/a.txt", ROW)
    text(tmp_path / "data.yaml", "names: [car, bus]\n")
    assert [found.class_names for _, found in read(tmp_path / "valid/images")] == [("bus",)]


@pytest.mark.parametrize(
    ("yaml", "names"),
    [
        ("names:\n  1: bus\n  0: car\n", NAMES),
        ("names: ['car, small', bus]\n", ("car, small", "bus")),
        ('names: {0: car, 2: "bus"}  # two\nnc: 2\n', ("car", "class 1", "bus")),
        ('"names": ["car",  # first\n  "bus"]\n', NAMES),
        ("names: &all\n- 'it''s'\n- bus #2\n", ("it's", "bus")),
    ],
)
def test_names_of_a_yaml_are_those_of_a_yaml_reader(
    tmp_path: Path, yaml: str, names: tuple[str, ...]
) -> None:
    """Names were taken in the order of the file, and cut at commas within quotes."""
    assert read_class_file(text(tmp_path / "data.yaml", yaml)) == names


@pytest.mark.parametrize("yaml", ["names: [car", "names: *nobody\n", "a: 1\n---\nnames: [car]\n", "[" * 5000])
def test_a_yaml_that_is_none_is_one_sentence(tmp_path: Path, yaml: str) -> None:
    """Half a file would give half of the classes."""
    with pytest.raises(UserError, match=r"data\.yaml is no YAML \("):
        read_class_file(text(tmp_path / "data.yaml", yaml))


@pytest.mark.parametrize("shape", ["kpt_shape: [3, 2]", "kpt_shape: [2, 3]", ""])
def test_keypoints_behind_a_box_are_no_polygon(tmp_path: Path, shape: str) -> None:
    """Labels of Ultralytics' pose gave boxes around the keypoints (ultralytics#13221)."""
    points = "0.1 0.2 0.3 0.4 0.5 0.6" if "2]" in shape else "0.2 0.3 2 0.4 0.6 0"
    picture(tmp_path / "images/a.jpg")
    text(tmp_path / "labels/a.txt", f"{ROW.strip()} {points}\n")
    text(tmp_path / "data.yaml", f"{shape}\nnames: [car, bus]\n")
    ((_, found),) = read(tmp_path)
    assert found.boxes_xyxy_px.tolist() == [BOX]


def test_a_decimal_comma_is_read(tmp_path: Path) -> None:
    """Such lines were called VisDrone's."""
    picture(tmp_path / "a.jpg")
    text(tmp_path / "a.txt", ROW.replace(".", ","))
    text(tmp_path / "classes.txt", "\n".join(NAMES))
    assert [found.boxes_xyxy_px.tolist() for _, found in read(tmp_path)] == [[BOX]]


@pytest.mark.parametrize("place", ["val2017", "images/val2017"])
def test_cocos_own_layout_is_found(tmp_path: Path, place: str) -> None:
    """Beside the boxes lie captions and keypoints of the same pictures; numbers may be text, names quoted."""
    picture(tmp_path / place / "a b.JPG")
    about = json.loads(coco("a%20b.jpg"))
    about["images"][0]["id"], about["categories"][0]["id"] = "1", "5"
    about["annotations"][0]["iscrowd"] = "0"
    text(tmp_path / "annotations/instances_val2017.json", json.dumps(about))
    text(tmp_path / "annotations/captions_val2017.json", '{"images": [], "annotations": []}')
    ((_, found),) = read(tmp_path)
    assert (found.class_names, found.boxes_xyxy_px.tolist()) == (("bus",), [BOX])


def test_a_picture_that_coco_names_twice_is_one(tmp_path: Path) -> None:
    """Sets that were joined so counted each half's objects as missed by the other."""
    about = json.loads(coco())
    about["images"].append({"id": 2, "file_name": "a.jpg"})
    about["annotations"].append({"id": 9, "image_id": 2, "category_id": 5, "bbox": [0, 0, 9, 9]})
    picture(tmp_path / "a.jpg")
    text(tmp_path / "coco.json", json.dumps(about))
    ((_, found),) = read(tmp_path)
    assert len(found) == 2


@pytest.mark.parametrize("number", [1, 2])
def test_boxes_of_nobody_knows_which_picture_are_refused(tmp_path: Path, number: int) -> None:
    """Two pictures of one id, as CVAT wrote them (cvat#7523); or two names that lead to one picture."""
    about = json.loads(coco("x/a.jpg"))
    about["images"].append({"id": number, "file_name": "b.jpg" if number == 1 else "y/a.jpg"})
    picture(tmp_path / "a.jpg")
    picture(tmp_path / "b.jpg")
    text(tmp_path / "coco.json", json.dumps(about))
    found = find_pictures(tmp_path, classes=None)
    assert all(one.labels is None for one in found)
    with pytest.raises(UserError, match="may be one of several pictures"):
        doubts_of(found)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("coco.json", coco().replace("[20.0, 10.0, 60.0, 50.0]", "[0.1, 0.1, 0.3, 0.5]"), "boxes of 0 to 1"),
        ("annotations.xml", "<annotations/>", "CVAT for images, which are not read"),
        ("a.json", '{"shapes": []}', "LabelMe, which are not read"),
    ],
)
def test_labels_that_are_not_read_are_said(tmp_path: Path, name: str, content: str, said: str) -> None:
    """The set was taken for pictures that nobody labelled, or for boxes of no size."""
    picture(tmp_path / "a.jpg")
    text(tmp_path / name, content)
    with pytest.raises(UserError, match=said):
        find_pictures(tmp_path, classes=None)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("label_2/a.txt", "Car 0.00 0 -1.58 100 50 300 200 1.6 1.6 3.9 1 1 1 -1.6"),
        ("labelTxt/a.txt", "100 50 300 50 300 200 100 200 car 0"),
        ("ann/a.jpg.json", "{}"),
        ("images/_annotations.createml.json", '[{"image": "a.jpg", "annotations": [{"coordinates": {}}]}]'),
        ("images/_annotations.csv", "filename,width,height,class,xmin,ymin,xmax,ymax"),
        ("val.json", '[{"name": "a.jpg", "labels": [{"box2d": {}}]}]'),
        ("val.odgt", '{"ID": "a", "gtboxes": []}'),
        ("via.json", '{"a.jpg1": {"regions": [{"shape_attributes": {}}]}}'),
    ],
)
def test_labels_of_another_kind_are_not_passed_over(tmp_path: Path, name: str, content: str) -> None:
    """A labelled set would be taken for one that nobody labelled, and nothing be scored."""
    picture(tmp_path / "images/a.jpg")
    text(tmp_path / "telemetry.csv", "time,x\n1,2")
    assert find_pictures(tmp_path, classes=None)[0].labels is None
    text(tmp_path / name, content)
    with pytest.raises(UserError, match="which are not read: export them as"):
        find_pictures(tmp_path, classes=None)


@pytest.mark.parametrize(
    "said",
    [
        "path: ../data\ntrain: images/train\nval: images/val\n",
        "path: {data}  # here\nval: images/val\n",
        "val: {data}/images/val\ntest: nowhere\n",
        "path: []\nval: {data}/images/val\n",
    ],
)
def test_a_yaml_may_lie_elsewhere_than_its_pictures(tmp_path: Path, said: str) -> None:
    """Ultralytics keeps its YAML apart; the set would not be found."""
    picture(tmp_path / "data/images/val/a.jpg")
    text(tmp_path / "data/labels/val/a.txt", ROW)
    yaml = text(tmp_path / "settings/ours.yaml", said.format(data=tmp_path / "data") + "names: [car, bus]\n")
    ((_, labels),) = read(yaml)
    assert labels.class_names == ("bus",)


def test_classes_that_count_from_1_are_refused(tmp_path: Path) -> None:
    """Each object would be of the next class, but for the last class, whose objects would be left out."""
    picture(tmp_path / "a.jpg")
    text(tmp_path / "a.txt", ROW + ROW.replace("1", "2", 1))
    text(tmp_path / "classes.txt", "car\nbus\n")
    with pytest.raises(
        UserError, match=r"line 2 has class 2; there are 2, .* none is of class 0: count classes"
    ):
        doubts_of([one for one, _ in read(tmp_path)])
    text(tmp_path / "a.txt", ROW + ROW.replace("1", "2", 1) + ROW.replace("1", "0", 1))
    assert "1 labels were left out" in doubts_of([one for one, _ in read(tmp_path)])[0]


def test_boxes_that_are_shares_where_pixels_are_expected_are_refused(tmp_path: Path) -> None:
    """Every object would be a third of a pixel large."""
    picture(tmp_path / "a.jpg")
    text(tmp_path / "a.xml", voc().replace(">20<", ">.1<").replace(">10<", ">.1<").replace(">60<", ">.6<"))
    assert read(tmp_path)
    text(tmp_path / "a.xml", (tmp_path / "a.xml").read_text().replace(">80<", ">.4<"))
    with pytest.raises(UserError, match="has boxes of 0 to 1"):
        read(tmp_path)


def test_what_coco_says_of_classes_and_crowds_counts(tmp_path: Path) -> None:
    """An object would have the second of two names of its class, or be a "None", and ignored ones missed."""
    picture(tmp_path / "a.jpg")
    about = json.loads(coco(box=[100, 10, 20, 20]))
    about["annotations"][1]["ignore"] = 1
    about["categories"] += [{"id": 7, "name": None}, {"id": 8, "name": "car"}, {"id": 8, "name": "van"}]
    about["annotations"] += [{**about["annotations"][0], "id": kind, "category_id": kind} for kind in (7, 8)]
    text(tmp_path / "labels.json", json.dumps(about))
    ((one, labels),) = read(tmp_path)
    assert labels.class_names == ("bus",)
    assert labels.beside_xyxy_px.tolist() == [[100, 10, 120, 30]]
    assert not len(labels.ignored_xyxy_px), "pycocotools counts what stands before a crowd"
    assert labels.passed_xyxy_px.tolist() == [[100, 10, 120, 30]], "it would be taught as background"
    assert "2 labels were left out" in doubts_of([one])[0]


def test_a_box_that_stands_there_twice_is_one(tmp_path: Path) -> None:
    """The second would be missed by every detector: tools that join sets write it."""
    picture(tmp_path / "a.jpg")
    text(tmp_path / "a.txt", ROW + ROW)
    text(tmp_path / "classes.txt", "car\nbus\n")
    ((one, labels),) = read(tmp_path)
    assert len(labels) == 1
    assert "a.txt, line 2 stands there twice" in doubts_of([one])[0]


@pytest.mark.parametrize("side", ["nan", "inf", "wide"])
def test_a_size_that_is_no_number_is_not_known(tmp_path: Path, side: str) -> None:
    """One label of thousands would end the training in a traceback."""
    picture(tmp_path / "a.jpg")
    text(tmp_path / "a.xml", voc().replace(f"<width>{SIZE[0]}<", f"<width>{side}<"))
    ((_, labels),) = read(tmp_path)
    assert labels.class_names == ("bus",)


def test_an_object_without_a_class_is_left_out(tmp_path: Path) -> None:
    """It would be of a class without a name."""
    picture(tmp_path / "a.jpg")
    whole = voc()
    text(
        tmp_path / "a.xml",
        whole.replace("</annotation>", whole[whole.index("<object>") :].replace("bus", "", 1)),
    )
    ((one, labels),) = read(tmp_path)
    assert labels.class_names == ("bus",)
    assert "has no class" in doubts_of([one])[0]


def test_a_coco_file_of_any_name_is_found(tmp_path: Path) -> None:
    """Its pictures would be taken for some that nobody labelled."""
    picture(tmp_path / "images/a.jpg")
    text(tmp_path / "ours.json", coco())
    text(tmp_path / "other.json", "{}")
    ((_, labels),) = read(tmp_path)
    assert len(labels) == 1


@pytest.mark.parametrize("place", ["annotations/ours.json", "ours.yaml"])
def test_a_macs_notes_on_files_are_none_of_the_set(tmp_path: Path, place: str) -> None:
    """Copied by a Mac, each file has one beside it that comes first: the set was refused."""
    picture(tmp_path / "images/a.jpg")
    is_coco = place.endswith("json")
    note = text(tmp_path / place, coco() if is_coco else "names: [car, bus]\n")
    text(note.with_name(f"._{note.name}"), "\0\5\x16\7Mac OS X")
    if not is_coco:
        text(tmp_path / "labels/a.txt", ROW)
    ((_, labels),) = read(tmp_path)
    assert labels.class_names == ("bus",)


def test_a_sensors_levels_are_shown_as_the_edge_shows_them(tmp_path: Path) -> None:
    """A thermal set of sixteen bits was one tone of grey to the detector that it judged."""
    levels = np.full((60, 80), 29_300, np.uint16)
    levels[20:40, 30:50] = 30_500
    cv2.imwrite(str(tmp_path / "a.tif"), levels)
    image = read_image(tmp_path / "a.tif")
    assert image is not None
    assert np.ptp(image) > 150


@pytest.mark.parametrize("encoding", ["iso-8859-1", "utf-16"])
def test_an_xml_is_read_in_its_encoding_and_difficult_objects_do_not_count(
    tmp_path: Path, encoding: str
) -> None:
    """VOC's own evaluation leaves them out."""
    picture(tmp_path / "a.jpg")
    head = f'<?xml version="1.0" encoding="{encoding}"?>'
    text(tmp_path / "a.xml", head + voc("lärm"), encoding)
    picture(tmp_path / "b.jpg")
    text(tmp_path / "b.xml", voc().replace("</name>", "</name><difficult>1</difficult>"))
    (_, first), (_, second) = read(tmp_path)
    assert first.class_names == ("lärm",)
    assert (len(second), second.beside_xyxy_px.tolist()) == (0, [BOX])


def test_folders_of_a_yaml_that_lie_in_each_other_count_once(tmp_path: Path) -> None:
    """Each picture of both would count twice; a shot beside the YAML would be the whole set."""
    for where in ("train", "more"):
        picture(tmp_path / f"data/images/{where}/{where}.jpg")
        text(tmp_path / f"data/labels/{where}/{where}.txt", ROW)
    yaml = text(
        tmp_path / "settings" / "a.yaml",
        f"train: {tmp_path}/data/images\nval: {tmp_path}/data/images/train\nnames: [car, bus]\n",
    )
    picture(tmp_path / "settings" / "shot.png")
    assert sorted(one.path.name for one, _ in read(yaml)) == ["more.jpg", "train.jpg"]


def test_a_table_or_a_route_beside_pictures_is_no_label(tmp_path: Path) -> None:
    """Pictures of a flight could not be looked at beside the flight's own log."""
    picture(tmp_path / "0.png")
    text(tmp_path / "flight.csv", "time,latitude,coordinates,alt\n1,2,3,4\n")
    text(tmp_path / "route.json", '{"type": "Point", "coordinates": [8, 47]}')
    text(tmp_path / "meta.json", '{"labels": ["day"]}')
    assert len(find_pictures(tmp_path, classes=None)) == 1


def test_a_picture_with_a_name_of_latin_1_is_read(tmp_path):
    """OpenCV ended the whole study in a segmentation fault."""
    name = tmp_path / os.fsdecode(b"caf\xe9.png")
    picture(tmp_path / "a.png").rename(name)
    assert read_image(name) is not None
