"""Labelled pictures as tools write them: where labels lie, and rows and sizes that do not fit."""

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
from hvt_study.datasets.labelled_pictures import doubts_of, find_pictures

SIZE = (200, 100)
BOX = [20.0, 10.0, 80.0, 60.0]
ROW = "1 0.25 0.35 0.3 0.5\n"
NAMES = ("car", "bus")
CLASSES = "car\nbus\n"
YAML = "names: [car, bus]\n"


def picture(path, size=SIZE, *, exif=None):
    path.parent.mkdir(parents=True, exist_ok=True)
    tags = Image.Exif()
    if exif is not None:
        tags[0x0112] = exif
    Image.fromarray(np.full((size[1], size[0], 3), 90, np.uint8)).save(path, exif=tags)
    return path


def text(path, content, encoding="utf-8"):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content.encode(encoding))
    return path


def lay(root, *pictures, **files):
    """Pictures by name, and files of text or (text, encoding); ``{root}`` in a text is the folder."""
    for name in pictures:
        picture(root / name)
    for name, content in files.items():
        said, encoding = content if isinstance(content, tuple) else (content, "utf-8")
        text(root / name, said.replace("{root}", str(root)), encoding)


def voc(name="bus", more=""):
    """As labelImg writes it."""
    x1, y1, x2, y2 = (int(side) for side in BOX)
    return (
        f"<annotation><size><width>{SIZE[0]}</width><height>{SIZE[1]}</height></size><object><name>{name}</name>{more}"
        f"<bndbox><xmin>{x1}</xmin><ymin>{y1}</ymin><xmax>{x2}</xmax><ymax>{y2}</ymax></bndbox></object></annotation>"
    )


def coco(name="a.jpg", box=None, change=lambda about: None, **image):
    """One picture with one bus, and a second row where a box is given."""
    x1, y1, x2, y2 = BOX
    boxes = [[x1, y1, x2 - x1, y2 - y1], *([box] if box is not None else [])]
    rows = [{"id": number, "image_id": 1, "category_id": 5, "bbox": one} for number, one in enumerate(boxes)]
    kinds = [{"id": 5, "name": "bus"}]
    about = {"images": [{"id": 1, "file_name": name, **image}], "categories": kinds, "annotations": rows}
    change(about)
    return json.dumps(about)


def numbers_as_text(about):
    about["images"][0]["id"], about["categories"][0]["id"], about["annotations"][0]["iscrowd"] = "1", "5", "0"


def read(place):
    """Every picture that can be read, with its labels."""
    found = []
    for one in find_pictures(place, classes=None):
        image = read_image(one.path, one.labelled_size)
        assert image is not None, one.unreadable
        labels = one.read((image.shape[1], image.shape[0]))
        assert labels is not None
        found.append((one, labels))
    return found


APART = "data/images/val/a.jpg", {"data/labels/val/a.txt": ROW}
LAYOUTS = {
    "Ultralytics, with a list over several lines": (
        "images/train/a.jpg",
        {
            "labels/train/a.txt": ROW,
            "data.yaml": (
                "path: .\ntrain: images/train\nnames:\n  0: car\n  1: 'bus'  # large\n",
                "utf-8-sig",
            ),
        },
    ),
    "Roboflow, a folder a split": (
        "train/images/a_jpg.rf.1.jpg",
        {"train/labels/a_jpg.rf.1.txt": ROW, "data.yaml": f"train: ../train/images\nnc: 2\n{YAML}"},
    ),
    "Roboflow, COCO": ("valid/a.jpg", {"valid/_annotations.coco.json": coco()}),
    "FiftyOne, YOLOv5Dataset": (
        "images/val/a.jpg",
        {"labels/val/a.txt": ROW, "dataset.yaml": "names:\n- car\n- bus\nnc: 2\n"},
    ),
    "FiftyOne, COCODetectionDataset": ("data/a.jpg", {"labels.json": coco()}),
    "labelImg, detected on before": (
        "a.jpg",
        {"a.txt": ROW, "classes.txt": CLASSES, "out/detections.csv": "a.jpg,20,10,80,60,0.9,bus\n"},
    ),
    "labelImg, VOC": ("a.jpg", {"a.xml": (voc(), "utf-8-sig")}),
    "Esri, VOC": ("images/a.jpg", {"labels/a.xml": voc().replace("<x", "<X").replace("</x", "</X")}),
    "CVAT, YOLO 1.1": ("obj_train_data/a.jpg", {"obj_train_data/a.txt": ROW, "obj.names": CLASSES}),
    "CVAT, COCO 1.0": ("images/a.jpg", {"annotations/instances_default.json": coco()}),
    "CVAT, PASCAL VOC 1.1": ("JPEGImages/a.jpg", {"Annotations/a.xml": voc()}),
    "Label Studio": ("images/a.jpg", {"labels/a.txt": ROW, "classes.txt": (CLASSES, "utf-16")}),
    "Label Studio, COCO, from Windows": (
        "images/a.jpg",
        {"result.json": (coco("images\\a.jpg"), "utf-8-sig")},
    ),
    **{  # sets from Windows and, the last, from macOS
        f"{shown} and {labels}": (
            shown,
            {labels: voc() if labels.endswith("XML") else ROW, "classes.txt": CLASSES},
        )
        for shown, labels in (
            *(
                ("A.JPG", "A.TXT"),
                ("Images/a.jpg", "Labels/a.txt"),
                ("a.jpg", "a.jpg.txt"),
                ("a.JPEG", "A.XML"),
            ),
            ("\u00e9.jpg", "e\u0301.txt"),
        )
    },
    **{  # labels of Ultralytics' pose gave boxes around the keypoints (ultralytics#13221)
        f"keypoints, {shape}": (
            "images/a.jpg",
            {"labels/a.txt": f"{ROW.strip()} {points}\n", "data.yaml": f"{shape}\n{YAML}"},
        )
        for shape, points in (
            ("kpt_shape: [3, 2]", "0.1 0.2 0.3 0.4 0.5 0.6"),
            ("kpt_shape: [2, 3]", "0.2 0.3 2 0.4 0.6 0"),
            ("", "0.2 0.3 2 0.4 0.6 0"),
        )
    },
    "a decimal comma": ("a.jpg", {"a.txt": ROW.replace(".", ","), "classes.txt": CLASSES}),
    **{  # beside the boxes lie captions and keypoints of the same pictures; numbers may be text, names quoted
        f"COCO's own, {place}": (
            f"{place}/a b.JPG",
            {
                "annotations/instances_val2017.json": coco("a%20b.jpg", change=numbers_as_text),
                "annotations/captions_val2017.json": '{"images": [], "annotations": []}',
            },
        )
        for place in ("val2017", "images/val2017")
    },
    "COCO of any name": ("images/a.jpg", {"ours.json": coco(), "other.json": "{}"}),
    "a Mac's note on COCO": (
        "images/a.jpg",
        {"annotations/ours.json": coco(), "annotations/._ours.json": "\0\5\x16\7Mac OS X"},
    ),
    "a Mac's note on a YAML": (
        "images/a.jpg",
        {"labels/a.txt": ROW, "ours.yaml": YAML, "._ours.yaml": "\0\5\x16\7Mac OS X"},
    ),
    **{
        f"a width of {side}": ("a.jpg", {"a.xml": voc().replace(f"<width>{SIZE[0]}<", f"<width>{side}<")})
        for side in ("nan", "inf", "wide")
    },
    # Ultralytics looks in labels/ beside images/, whatever folder it was given, and keeps its YAML apart.
    "valid/images": ("valid/images/a.jpg", {"valid/labels/a.txt": ROW, "data.yaml": YAML}),
    **{
        f"settings/{number}.yaml": (APART[0], {**APART[1], f"settings/{number}.yaml": said + YAML})
        for number, said in enumerate(
            (
                "path: ../data\ntrain: images/train\nval: images/val\n",
                "path: {root}/data  # here\nval: images/val\n",
                "val: {root}/data/images/val\ntest: nowhere\n",
                "path: []\nval: {root}/data/images/val\n",
            )
        )
    },
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_layouts_of_tools_are_found(tmp_path, layout):
    """Whoever labels with another tool would have to move a thousand files first, or have a set without labels."""
    shown, files = LAYOUTS[layout]
    lay(tmp_path, shown, **files)
    given = layout.startswith(("valid", "settings"))
    ((one, labels),) = read(tmp_path / layout if given else tmp_path)
    assert labels.class_names == ("bus",)
    np.testing.assert_allclose(labels.boxes_xyxy_px, [BOX], atol=0.01)
    assert doubts_of([one]) == []


def test_one_bad_row_costs_itself_alone(tmp_path):
    """A side of 1.0005, which exporters write, ended the whole set."""
    rows = ["0 0.25 0.50025 0.5 1.0005", "0 0.9 0.5 0.4 0.2", "9 0.5 0.5 0.1 0.1", "car", "0 3 0.5 0.1 0.1"]
    rows += ["0 nan .5 .1 .1", ROW, "1 0.1 0.1 0.4 0.1 0.4 0.6 0.1 0.6"]
    lay(tmp_path, "a.jpg", **{"a.txt": "\n".join(rows), "classes.txt": CLASSES})
    ((one, labels),) = read(tmp_path)
    assert labels.class_names == ("car", "car", "bus", "bus")
    wanted = [[0, 0, 100, 100], [140, 40, 200, 60], BOX, [20, 10, 80, 60]]
    np.testing.assert_allclose(labels.boxes_xyxy_px, wanted, atol=0.01)
    cut, left_out = doubts_of([one])
    assert "2 labels end outside their picture and were cut; the worst is" in cut
    assert "a.txt, line 2, by 20 px" in cut
    assert "4 labels were left out; the first: " in left_out
    assert "a.txt, line 3 has class 9; there are 2, from 0" in left_out


@pytest.mark.parametrize(
    ("box", "boxes", "words"),
    [
        ([-0.5, 10, 20, 20], [BOX, [0, 10, 19.5, 30]], "COCO annotation 1 of labels.json, by 0.5 px"),
        ([190, 90, 20, 20], [BOX, [190, 90, 200, 100]], "by 10 px"),
        ([500, 90, 20, 20], [BOX], "1 labels were left out; the first: COCO annotation 1"),
        ([1, 2, 3], [BOX], "bbox [1, 2, 3], has no box"),
        ([float("nan"), 1, 2, 3], [BOX], "bbox [nan, 1, 2, 3], has no box"),
        ([10**400, 1, 2, 3], [BOX], "bbox [1000"),
        ([5, 5, -2, 4], [BOX], "has a box outside the picture of 200x100, or without area"),
        ("none", [BOX], "bbox none, has no box: accepted are"),
    ],
)
def test_boxes_of_coco_are_cut_at_the_picture(tmp_path, box, boxes, words):
    """An x of -0.5, which annotators write, ended the whole set."""
    lay(tmp_path, "data/a.jpg", **{"labels.json": coco(box=box)})
    ((one, labels),) = read(tmp_path / "labels.json")
    np.testing.assert_allclose(labels.boxes_xyxy_px, boxes, atol=1e-4)
    (said,) = doubts_of([one])
    assert words in said


def test_a_picture_that_was_labelled_as_it_lies_is_read_so(tmp_path):
    """A phone's picture is turned by its EXIF tag, its labels are not: recall 0.0 without a word."""
    picture(tmp_path / "data/a.jpg", exif=6)
    for width, height in ((200, 100), (100, 200)):  # the second was labelled as it is shown
        text(tmp_path / "labels.json", coco(width=width, height=height))
        ((one, labels),) = read(tmp_path)
        assert read_image(one.path, one.labelled_size).shape == (height, width, 3)
        if height == 100:
            np.testing.assert_allclose(labels.boxes_xyxy_px, [BOX])
            write_sheet(tmp_path / "sheet.png", [Finding(one, [150, 20, 190, 60], "", 1.0)])
            sheet = cv2.imread(str(tmp_path / "sheet.png"))
            assert sheet[75, 75].tolist() == [90, 90, 90], "and the place of a box is shown where it lies"


@pytest.mark.parametrize("width", [200, "200", 200.0, None])
def test_a_picture_that_was_resized_has_its_boxes_scaled(tmp_path, width):
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


def test_a_picture_that_is_not_there_is_called_so(tmp_path):
    """A path that is wrong would be looked for among damaged files."""
    for name in (f"{'a' * 300}.jpg", "a.jpg"):
        text(tmp_path / "labels.json", coco(name))
        (one,) = find_pictures(tmp_path / "labels.json", classes=None)
        assert one.unreadable.endswith("a.jpg does not exist")
    text(one.path, "no picture")
    assert one.unreadable.endswith("a.jpg cannot be read as a picture")
    assert cv2.imread(str(one.path)) is None


@pytest.mark.parametrize(
    ("yaml", "names"),
    [
        ("names:\n  1: bus\n  0: car\n", NAMES),
        ("names: ['car, small', bus]\n", ("car, small", "bus")),
        ('names: {0: car, 2: "bus"}  # two\nnc: 2\n', ("car", "class 1", "bus")),
        ('"names": ["car",  # first\n  "bus"]\n', NAMES),
        ("names: &all\n- 'it''s'\n- bus #2\n", ("it's", "bus")),
        ('names: {0: , 1: "bus\\e[31m"}\n', ("class 0", "bus?[31m")),
        *(
            (bad, r"is no YAML \(")
            for bad in ("names: [car", "names: *nobody\n", "a: 1\n---\nnames: [car]\n", "[" * 5000)
        ),
        *(
            (f"names: {{0: {bad}, 1: bus}}\n", "has no class names; accepted is names: with")
            for bad in ("[car]", "{a: b}", "!!set {car}")
        ),
    ],
)
def test_names_of_a_yaml_are_those_of_a_yaml_reader(tmp_path, yaml, names):
    """Names were taken in the order of the file, and cut at commas within quotes; half a file would give half."""
    path = text(tmp_path / "data.yaml", yaml)
    if isinstance(names, tuple):
        assert read_class_file(path) == names
    else:
        with pytest.raises(UserError, match=rf"data\.yaml {names}"):
            read_class_file(path)


def twice(about):
    about["images"].append({"id": 2, "file_name": "a.jpg"})
    about["annotations"].append({"id": 9, "image_id": 2, "category_id": 5, "bbox": [0, 0, 9, 9]})


def another_image(number, name):
    return lambda about: about["images"].append({"id": number, "file_name": name})


UNKNOWN_PICTURE = "may be one of several pictures"
UNREAD = "which are not read: export them as"
OUTSIDE = r"a\.txt, line 1 has a box outside the picture"
FROM_ONE = r"line 2 has class 2; there are 2, .* none is of class 0: count classes"
REFUSED = [
    ({"labels/c.txt": ROW}, r"has no label of any of its 2 pictures, such as a\.jpg: looked in labels/"),
    ({"labels/a.txt": ROW}, r"no classes\.txt, obj\.names or data\.yaml"),
    # Two pictures of one id, as CVAT wrote them (cvat#7523); or two names that lead to one picture.
    ({"coco.json": coco("x/a.jpg", change=another_image(1, "b.jpg"))}, UNKNOWN_PICTURE),
    ({"coco.json": coco("x/a.jpg", change=another_image(2, "y/a.jpg"))}, UNKNOWN_PICTURE),
    ({"coco.json": coco().replace("[20.0, 10.0, 60.0, 50.0]", "[0.1, 0.1, 0.3, 0.5]")}, "boxes of 0 to 1"),
    ({"annotations.xml": "<annotations/>"}, "CVAT for images, which are not read"),
    ({"images/a.json": '{"shapes": []}'}, "LabelMe, which are not read"),
    ({"label_2/a.txt": "Car 0.00 0 -1.58 100 50 300 200 1.6 1.6 3.9 1 1 1 -1.6"}, UNREAD),
    ({"labelTxt/a.txt": "100 50 300 50 300 200 100 200 car 0"}, UNREAD),
    ({"ann/a.jpg.json": "{}"}, UNREAD),
    (
        {"images/_annotations.createml.json": '[{"image": "a.jpg", "annotations": [{"coordinates": {}}]}]'},
        UNREAD,
    ),
    ({"images/_annotations.csv": "filename,width,height,class,xmin,ymin,xmax,ymax"}, UNREAD),
    ({"val.json": '[{"name": "a.jpg", "labels": [{"box2d": {}}]}]'}, UNREAD),
    ({"val.odgt": '{"ID": "a", "gtboxes": []}'}, UNREAD),
    ({"gt.txt": "1,1,20,10,40,40,car"}, UNREAD),
    ({"groundtruth.txt": "20,10,40,40"}, UNREAD),
    ({"images/GOT-1/1.jpg": "", "images/GOT-1/groundtruth.txt": "20,10,40,40"}, UNREAD),
    ({"images/cat/cat-1/img/1.jpg": "", "images/cat/cat-1/groundtruth.txt": "20,10,40,40"}, UNREAD),
    ({"boxes.csv": "ImageID,LabelName,XMin,XMax,YMin,YMax"}, UNREAD),
    ({"boxes.csv": ("filename;xmin;ymin;xmax;ymax;class", "utf-16")}, UNREAD),
    ({"train.jsonl": '{"image": "a.jpg", "bbox": [1, 2, 3, 4]}'}, UNREAD),
    ({"vott.json": '{"regions": [{"boundingBox": {}}]}'}, UNREAD),
    ({"via.json": '{"a.jpg1": {"regions": [{"shape_attributes": {}}]}}'}, UNREAD),
    (
        {"annotations/stuff_a.json": coco(), "annotations/panoptic_a.json": "{}"},
        "but for captions_…, panoptic",
    ),
    ({"stuff_a.json": coco(), "panoptic_a.json": coco()}, UNREAD),
    ({"images/a.xml": "<kml/>"}, r"a\.xml is not an XML of Pascal VOC \(its root is kml"),
    # Of labels in pixels nothing is right; of classes from 1, each would be the next one, and the last left out.
    (
        {"images/a.txt": "1 50 35 60 50\n", "classes.txt": CLASSES},
        OUTSIDE,
    ),
    (
        {"images/a.txt": ROW + ROW.replace("1", "2", 1), "classes.txt": CLASSES},
        FROM_ONE,
    ),
    (
        {
            "images/a.xml": voc()
            .replace("20<", ".1<")
            .replace(">10<", ">.1<")
            .replace("60<", ".6<")
            .replace("80<", ".4<")
        },
        "has boxes of 0 to 1",
    ),
]


def test_pictures_that_are_left_out_of_a_set_are_said(tmp_path):
    """A set was half as large as its folder, without a word."""
    lay(tmp_path, "a.jpg", "a.png", "b.jpg", "b.png")
    found = find_pictures(tmp_path, classes=None)
    assert [one.path.name for one in found] == ["a.jpg", "b.jpg"]
    assert [said.partition(" names: ")[2] for said in doubts_of(found)] == ["2 .png"]


@pytest.mark.parametrize(("files", "said"), REFUSED)
def test_labels_that_cannot_be_judged_by_are_refused(tmp_path, files, said):
    """The set was taken for pictures that nobody labelled, for boxes of no size, or each for the next class."""
    lay(tmp_path, "images/a.jpg", "images/b.jpg", **files)
    with pytest.raises(UserError, match=said):
        judged(tmp_path, late=said in (UNKNOWN_PICTURE, OUTSIDE, FROM_ONE))


def judged(root, *, late):
    found = find_pictures(root, classes=None)
    assert late, "it is told when a detector has looked at all pictures"
    doubts_of([one for one in found if one.read(SIZE) or True])


def test_files_beside_pictures_that_are_no_labels_are_passed_over(tmp_path):
    """Pictures of a flight could not be looked at beside the flight's own log."""
    place = tmp_path / "day"
    lay(
        place,
        "0.png",
        **{"flight.csv": "time,latitude,coordinates,alt\n1,2,3,4\n", "t.csv": "time,x\n1,2"},
        **{"route.json": '{"type": "Point", "coordinates": [8, 47]}', "meta.json": '{"labels": ["day"]}'},
        **{"weather.csv": "maxMinTemp,vox_min\n1,2", "0.png.aux.xml": "<GeographicBoundingBox/>"},
        **{"../ann/0.json": "{}", "groundtruth.txt": "# timestamp tx ty\n1305031098.66 1.35 0.63 1.63\n"},
    )
    assert [one.labels for one in find_pictures(place, classes=None)] == [None]
    text(tmp_path / "groundtruth.txt", "20,10,40,40")
    with pytest.raises(UserError, match=UNREAD):
        find_pictures(place, classes=None)


@pytest.mark.parametrize(
    "files",
    [
        {"anno/bike1.txt": "NaN,NaN,NaN,NaN\n20,10,60,50\n"},  # UAV123
        {"anno/img_2.txt": "20,10,60,50\n" * 2, "img/c.jpg": "", "img/d.jpg": ""},
        {"img/groundtruth_rect.2.txt": "20\t10\t60\t50\n" * 2},  # OTB, of two targets
        {"export/a.ndjson": '{"external_id": "a.jpg", "projects": {"annotations": {"objects": []}}}'},
        {"gt/a.txt": ROW},
        {"labels.csv": "image,a,b,c,d,label\na.jpg,20,10,80,60,bus\n"},
        {"train.txt": "img/a.jpg 20,10,80,60,1\n"},
        {"train.tfrecord": "\n"},
        {"img/c.txt": ROW, "img/a.txt": ROW, "classes.txt": CLASSES},  # c has no picture
        {"img/c.json": '{"shapes": []}', "img/a.txt": ROW, "classes.txt": CLASSES},
    ],
)
def test_files_that_are_not_understood_are_named(tmp_path, files):
    """Pictures were "not labelled", and nobody said that the file beside them was passed over."""
    lay(tmp_path, "img/a.jpg", "img/b.jpg", **files)
    found = find_pictures(tmp_path, classes=None)
    first = next(iter(files))
    assert doubts_of(found)[0].startswith(f"1 files were not read as labels, the first: {tmp_path / first}; ")


NUMBERS = "1.5,2,3,4,5\n" * 2
NO_LABELS = {
    "times.txt": "0.0\n0.1\n0.2\n0.3\n",
    "calib.txt": "P0: 7.1e+02 0 6.0e+02 0\n",
    "names.txt": "a" + "," * 60000,
    "poses.csv": "time_s,latitude_deg,longitude_deg,height_m\n" + "0,47,8,30\n" * 2,
    "gps.txt": "a.jpg 47 8 430 12\n",
    "ImageSets/Main/train.txt": "a\n1\n2\n3\n4\n",
    "runs/train/results.csv": NUMBERS,
    "calib.npz": "x",
    "images_1.txt": "47.1 8.5 100 1\n" * 3,
    "rec/tracks.csv": "frame,x_min,y_min,x_max,y_max\n" + NUMBERS,
    "odm/stats.json": '{"bbox": [1, 2, 3, 4]}',
    "sparse/0/images.txt": "1 0.5 0.5 0.5 0.5 1 2 3 1 a.jpg\n",
}


@pytest.mark.parametrize(
    "labels",
    [
        {},
        {"images/a.txt": ROW, "images/classes.txt": "0\n1\n2\n3\n4\n", "package.json": '{"annotations": 1}'},
        {"annotations/instances_a.json": coco(), "annotations/person_keypoints_a.json": coco()},
    ],
)
def test_files_that_are_no_labels_are_not_named(tmp_path, monkeypatch, labels):
    """Each set with a log beside it was said to have labels that nobody read; a folder of the disk's own ended it."""
    lay(tmp_path, "images/a.jpg", "images/b.jpg", **NO_LABELS, **labels, **{"lost+found/a.txt": ROW})
    listed = Path.iterdir

    def iterdir(folder):
        if folder.name == "lost+found":
            raise PermissionError(13, "Permission denied")
        return listed(folder)

    monkeypatch.setattr(Path, "iterdir", iterdir)
    monkeypatch.setattr("os.access", lambda folder, _: folder.name != "lost+found")
    assert doubts_of(find_pictures(tmp_path, classes=None)) == []


XML_OBJECT = voc()[voc().index("<object>") :]
VISDRONE = "{},10,60,50,1,9,0,0\n"
LEFT_OUT = {
    "a class beyond the last": (
        {"a.txt": ROW + ROW.replace("1", "2", 1) + ROW.replace("1", "0", 1), "classes.txt": CLASSES},
        2,
        "1 labels were left out",
    ),
    "twice, as tools that join sets write it": (
        {"a.txt": ROW + ROW, "classes.txt": CLASSES},
        1,
        "a.txt, line 2 stands there twice",
    ),
    "without a class": (
        {"a.xml": voc().replace("</annotation>", XML_OBJECT.replace("bus", "", 1))},
        1,
        "has no class",
    ),
    "some shares among pixels": (
        {"a.xml": voc().replace(">20<", ">.1<").replace(">10<", ">.1<").replace(">60<", ">.6<")},
        1,
        None,
    ),
    "VisDrone's, outside": (
        {"a.txt": VISDRONE.format(20) + VISDRONE.format(500)},
        1,
        "1 labels were left out; the first: {}, line 2 has a box outside the picture of 200x100",
    ),
    "VisDrone's, partly outside": (
        {"a.txt": VISDRONE.format(20) + VISDRONE.format(150)},
        2,
        "1 labels end outside their picture and were cut; the worst is {}, line 2, by 10 px",
    ),
    "a picture that COCO names twice is one": ({"coco.json": coco(change=twice)}, 2, None),
}


@pytest.mark.parametrize("case", LEFT_OUT)
def test_a_row_that_is_none_is_left_out_with_a_word(tmp_path, case):
    """It would be missed by every detector, or be of a class without a name."""
    files, count, words = LEFT_OUT[case]
    lay(tmp_path, "a.jpg", **files)
    ((one, labels),) = read(tmp_path)
    assert len(labels) == count
    assert "bus" in labels.class_names
    said = doubts_of([one])
    assert words.format(tmp_path / "a.txt") in said[0] if words else said == []


def test_what_coco_says_of_classes_and_crowds_counts(tmp_path):
    """An object would have the second of two names of its class, or be a "None", and ignored ones missed."""

    def change(about):
        rows = about["annotations"]
        rows[1]["ignore"] = 1
        about["categories"] += [{"id": 7, "name": None}, {"id": 8, "name": "car"}, {"id": 8, "name": "van"}]
        about["categories"].append({"id": [6], "name": "bus"})
        about["images"].append({"id": [1], "file_name": "a.jpg"})
        broken = [*({"category_id": kind} for kind in (7, 8, [9], None)), {"image_id": None}]
        rows += [{**rows[0], **one, "bbox": [9, 9, 20 + place, 9]} for place, one in enumerate(broken)]

    lay(tmp_path, "a.jpg", **{"labels.json": coco(box=[100, 10, 20, 20], change=change)})
    ((one, labels),) = read(tmp_path)
    assert labels.class_names == ("bus",)
    assert labels.beside_xyxy_px.tolist() == [[100, 10, 120, 30]]
    assert not len(labels.ignored_xyxy_px), "pycocotools counts what stands before a crowd"
    assert labels.passed_xyxy_px.tolist() == [[100, 10, 120, 30]], "it would be taught as background"
    assert "5 labels were left out" in doubts_of([one])[0]


def test_a_sensors_levels_are_shown_as_the_edge_shows_them(tmp_path):
    """A thermal set of sixteen bits was one tone of grey to the detector that it judged."""
    levels = np.full((60, 80), 29_300, np.uint16)
    levels[20:40, 30:50] = 30_500
    cv2.imwrite(str(tmp_path / "a.tif"), levels)
    assert np.ptp(read_image(tmp_path / "a.tif")) > 150


@pytest.mark.parametrize("encoding", ["iso-8859-1", "utf-16"])
def test_an_xml_is_read_in_its_encoding_and_difficult_objects_do_not_count(tmp_path, encoding):
    """VOC's own evaluation leaves them out."""
    head = f'<?xml version="1.0" encoding="{encoding}"?>'
    files = {"a.xml": (head + voc("lärm"), encoding), "b.xml": voc(more="<difficult>1</difficult>")}
    lay(tmp_path, "a.jpg", "b.jpg", **files)
    (_, first), (_, second) = read(tmp_path)
    assert first.class_names == ("lärm",)
    assert (len(second), second.beside_xyxy_px.tolist()) == (0, [BOX])


def test_folders_of_a_yaml_that_lie_in_each_other_count_once(tmp_path):
    """Each picture of both would count twice; a shot beside the YAML would be the whole set."""
    for where in ("train", "more"):
        lay(tmp_path, f"data/images/{where}/{where}.jpg", **{f"data/labels/{where}/{where}.txt": ROW})
    yaml = tmp_path / "settings" / "a.yaml"
    text(yaml, f"train: {tmp_path}/data/images\nval: {tmp_path}/data/images/train\n{YAML}")
    picture(tmp_path / "settings" / "shot.png")
    assert sorted(one.path.name for one, _ in read(yaml)) == ["more.jpg", "train.jpg"]


def test_a_picture_with_a_name_of_latin_1_is_read(tmp_path):
    """OpenCV ended the whole study in a segmentation fault."""
    name = tmp_path / os.fsdecode(b"caf\xe9.png")
    picture(tmp_path / "a.png").rename(name)
    assert read_image(name) is not None
