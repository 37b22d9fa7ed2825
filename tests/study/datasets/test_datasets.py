"""Datasets by URI, in small copies of their real layouts."""

import pickle
import shutil
from contextlib import nullcontext
from unittest.mock import Mock

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from hvt_common.errors import UserError
from hvt_scene import Scene
from hvt_study.datasets.annotation_rows import read_rows
from hvt_study.datasets.labels import NO_ID
from hvt_study.datasets.layouts.mot import mot_table, read_truth_rows
from hvt_study.datasets.layouts.uri import open_dataset, open_datasets
from hvt_study.datasets.sequence import content_hash, stage_clip
from media.clips import smooth_pictures
from media.numbered import number_of, write_numbered
from studies.layouts import SIZE, square_xywh, write_images, write_mot, write_uavdt, write_visdrone


def xyxy(x, y, w, h):
    return [x, y, x + w, y + h]


def test_visdrone_labels(tmp_path):
    """A box shifted by a frame, or an ignored region taken for an object, would spoil every table of the paper."""
    write_visdrone(tmp_path, "uav0000086_00000_v", "uav0000117_02622_v")
    first, second = open_dataset(f"visdrone:{tmp_path}")
    assert (first.name, second.name) == ("uav0000086_00000_v", "uav0000117_02622_v")
    assert (first.dataset, first.frame_count, first.fps, first.source_size) == ("visdrone", 6, 30, SIZE)
    assert {"car", "van", "awning-tricycle"} <= set(first.class_set)
    for index in (0, 5):
        labels = first.labels(index)
        assert labels.boxes_xyxy_px.tolist() == [xyxy(*square_xywh(index)), [140, 10, 160, 20]]
        assert labels.boxes_xyxy_px.dtype == np.float32
        assert labels.class_names == ("van", "car")
        assert labels.ids.tolist() == [7, 8]
        assert labels.ignored_xyxy_px.shape == labels.beside_xyxy_px.shape == (0, 4)
    labels = first.labels(1)
    assert labels.ids.tolist() == [7, 8]  # the pedestrian lies where nobody has labelled anything
    assert labels.ignored_xyxy_px.tolist() == [[100, 60, 120, 80]]
    assert labels.beside_xyxy_px.tolist() == [[5, 80, 13, 88], [20, 80, 28, 88]]  # others, and a score of 0


@pytest.mark.parametrize(
    ("fps", "shown"),
    [(30, [0, 2, 4, 6]), (24, [0, 1, 3, 4, 6]), (10, [0, 0, 1, 2, 2, 3, 4, 4, 5, 6, 6])],
)
def test_a_frame_of_the_clip_shows_the_source_frame_of_its_labels(tmp_path, fps, shown):
    """At 15 frames a second, every second frame of 30: labels a frame off are wrong for all that moves."""
    write_visdrone(tmp_path, "a", count=7)
    drawn = smooth_pictures(7, size=SIZE)
    (sequence,) = open_dataset(f"visdrone:{tmp_path}?fps={fps}")
    assert [sequence.source_frame(frame_index) for frame_index in range(sequence.clip_frames)] == shown
    assert np.array_equal(list(sequence.clip.images()), [drawn[index] for index in shown])
    assert sequence.labels_at(2).boxes_xyxy_px[0].tolist() == xyxy(*square_xywh(shown[2]))
    limited = sequence.limited(2)
    assert limited.clip_frames == len(list(limited.clip.images())) == 2
    assert limited.duration_s == pytest.approx(7 / fps)


def test_several_splits_below_one_root(tmp_path):
    """The 79 clips come in downloads of their own; a name that two of them have must stay unique."""
    for split in ("train", "val"):
        write_visdrone(tmp_path / split, "uav1", f"uav-{split}")
    names = [sequence.name for sequence in open_dataset(f"visdrone:{tmp_path}")]
    assert sorted(names) == ["uav-train", "uav-val", "uav1", "val/uav1"]


def test_only_some_are_opened(tmp_path):
    """A study of one clip must not fail for another's damage, nor read it; nor be cut down to one of two datasets."""
    write_visdrone(tmp_path / "one", "good", "other")
    write_visdrone(tmp_path / "one", "bad", rows="1;2;3\n")
    write_visdrone(tmp_path / "two", "c")
    uris = [f"visdrone:{tmp_path / name}" for name in ("one", "two", "one")]
    for only, limit, names in (
        (["good", "oth*"], None, ["good", "other"]),
        (["[go]*"], 1, ["good"]),
        (["good", "c*"], None, ["good", "c"]),
        (["c"], None, ["c"]),
        (["[go]*", "c"], 1, ["good", "c"]),
    ):
        assert [one.name for _, one in open_datasets(uris, only=only, limit=limit)] == names
    with pytest.raises(UserError, match=r"no sequence 'uav9': there are bad, good, other"):
        open_dataset(uris[0], only=["uav9"])
    said = r"datasets .*one' and .*two' have no sequence 'd': there are bad, good, other, c"
    with pytest.raises(UserError, match=said):
        list(open_datasets(uris, only=["good", "d"]))


def test_a_sequence_travels_to_other_processes(tmp_path):
    """Runs are flown in processes of their own; what they are sent must be small and whole."""
    write_visdrone(tmp_path, "a")
    (sequence,) = open_dataset(f"visdrone:{tmp_path}")
    sent = pickle.dumps(sequence)
    assert len(sent) < 2000
    again = pickle.loads(sent)
    assert np.array_equal(again.labels(3).boxes_xyxy_px, sequence.labels(3).boxes_xyxy_px)
    assert np.array_equal(next(again.clip.images()), next(sequence.clip.images()))


@pytest.mark.parametrize(
    ("row", "line"),
    [
        ("1;2;3", 2),
        ("1,7,0,0,ten,9,1,4,0,0", 2),
        ("1,7,0,0", 2),
        ("1,7,9,9,1,4,0,0", 2),  # as in the layout for single images
        ("1,7,0,0,9,9,1,12,0,0", 2),
        ("1,7,0,0,9,9,1,4.5,0,0", 2),
        ("1,7,0,0,nan,9,1,4,0,0", 2),
        ("1,7,0,0,1e300,9,1,4,0,0", 2),
        ("1,7,9,9,-9,9,1,4,0,0", 2),
        (f"1,{2**53},0,0,9,9,1,4,0,0", 2),
        ("1.5,7,0,0,9,9,1,4,0,0", 2),
        ("-1,7,0,0,9,9,1,4,0,0", 2),
        ("\n\n1,7,0,0,9,9,1,x,0,0", 4),
    ],
)
def test_a_bad_annotation_costs_itself_and_is_named_with_file_and_line(tmp_path, row, line, caplog):
    """One of forty thousand lines would end the study, or be nothing without a word."""
    write_visdrone(tmp_path, "a", rows=f"1,1,0,0,9,9,1,4,0,0\n{row}\n")
    (sequence,) = open_dataset(f"visdrone:{tmp_path}")
    assert sequence.labels(0).class_names == ("car",)
    file = tmp_path / "annotations" / "a.txt"
    assert f"1 of 2 lines are left out; the first: {file}, line {line} is" in caplog.text
    file.write_text(f"\n{row}\n")
    with pytest.raises(UserError) as caught:
        open_dataset(f"visdrone:{tmp_path}")
    assert f"{file}, line {line if line == 2 else 4} is" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("scheme", ["visdrone", "uavdt", "mot"])
def test_labels_of_larger_or_turned_pictures_are_refused(tmp_path, scheme):
    """Boxes of large pictures on small ones, or beside those that an EXIF tag turns: recall 0 without a word."""
    write = {"visdrone": lambda: write_visdrone(tmp_path, "a"), "uavdt": lambda: write_uavdt(tmp_path)}
    write.get(scheme, lambda: write_mot(tmp_path / "a", info="[Sequence]\nframeRate=25\n"))()
    open_dataset(f"{scheme}:{tmp_path}")
    for file in tmp_path.rglob("*.png"):
        cv2.imwrite(str(file), np.zeros((SIZE[0] // 8, SIZE[1] // 8, 3), np.uint8))
    with pytest.raises(
        UserError, match=r"boxes outside its pictures of 12x20: put the pictures back that were"
    ):
        open_dataset(f"{scheme}:{tmp_path}")


IN, OUT, ABSENT = "141,11,9,9", "241,11,9,9", "0,0,0,0"


@pytest.mark.parametrize(
    ("boxes", "turned", "refused"),
    [
        ([*[IN] * 9, OUT], 1, False),
        ([*[IN] * 8, OUT], 1, True),
        ([IN, *[ABSENT] * 9], 1, False),
        ([*[IN] * 8, OUT, *[ABSENT] * 9], 1, True),
        ([IN], 6, True),
    ],
)
def test_more_than_a_tenth_of_boxes_outside_tells_of_other_pictures(tmp_path, boxes, turned, refused):
    """Objects that leave the picture, or are absent, are no fault; and a turn is in no file of labels."""
    rows = "".join(f"{1 + number % 6},{number},{box},1,1,1\n" for number, box in enumerate(boxes, start=1))
    write_mot(tmp_path / "a", rows=rows)
    tags = Image.Exif()
    tags[0x0112] = turned
    for file in tmp_path.rglob("*.png"):
        Image.open(file).save(file.with_suffix(".jpg"), exif=tags)
        file.unlink()
    with pytest.raises(UserError, match="boxes outside its pictures") if refused else nullcontext():
        assert open_dataset(f"mot:{tmp_path}")[0].labels is not None


A = "sequences/a"


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda root: shutil.rmtree(root / "sequences"), "has no folder sequences: expected is"),
        (lambda root: shutil.rmtree(root / "annotations"), "has no annotations"),
        (lambda root: shutil.rmtree(root / A), "is empty"),
        (lambda root: (root / A / "0000003.png").unlink(), "lacks image 3"),
        (lambda root: (root / A / "3.png").write_bytes(b""), "has two images of number 3"),
        (lambda root: (root / A / "x.png").write_bytes(b""), "has no number"),
        (lambda root: (root / A / "0000001.png").write_bytes(b"no"), "cannot be read as an image"),
        (lambda root: (root / "annotations/a.txt").write_text(""), "are empty"),
        (lambda root: (root / "annotations/a.txt").write_bytes(b"\xff\xfe\x00"), "not UTF-8 text"),
        (lambda root: [file.unlink() for file in (root / A).iterdir()], "holds no images"),
        (lambda root: (root / "sequences").rename(root / "images"), "use still:"),
        (shutil.rmtree, "does not exist"),
    ],
)
def test_what_a_layout_lacks_is_one_sentence(tmp_path, spoil, said):
    """The user is told what to add, before hours of flights."""
    root = tmp_path / "root"
    write_visdrone(root, "a")
    spoil(root)
    with pytest.raises(UserError, match=said) as caught:
        open_dataset(f"visdrone:{root}")
    assert "\n" not in str(caught.value)
    assert str(root) in str(caught.value)


def test_pictures_that_a_layout_leaves_out_are_said(tmp_path, caplog):
    """Of 1.jpg and 1.png nobody knew which one was flown over."""
    write_visdrone(tmp_path, "a")
    shutil.copytree(tmp_path / A, tmp_path / "still" / "images")
    for file in tmp_path.rglob("0000003.png"):
        shutil.copy(file, file.with_suffix(".tif"))
    for place in (f"visdrone:{tmp_path}", f"still:{tmp_path}/still?labels=none"):
        caplog.clear()
        open_dataset(place)
        assert [one.getMessage().partition(" names: ")[2] for one in caplog.records] == ["1 .tif"]


def test_annotations_without_an_object_are_refused(tmp_path):
    """Every box over an empty file of UAVDT was false; of MOTChallenge it was said that classes do not match."""
    root = tmp_path / "root"
    write_visdrone(tmp_path / "drone", "a")
    shutil.copytree(tmp_path / "drone" / "sequences" / "a", root / "M0203" / "img1")
    (root / "M0203_gt_whole.txt").write_text("")
    (root / "M0203" / "gt").mkdir()
    (root / "M0203" / "gt" / "gt.txt").write_text("\n")
    (root / "M0203" / "gt" / "labels.txt").write_text("car\n")
    for uri in (f"uavdt:{root}", f"mot:{root}?fps=30"):
        with pytest.raises(UserError, match=r"annotations .* are empty"):
            open_dataset(uri)


@pytest.mark.parametrize(
    ("uri", "said"),
    [
        ("visdrone", "is unknown: accepted are visdrone:ROOT"),
        ("coco:/data", "is unknown"),
        ("visdrone:", "does not exist"),
        ("mot:{}/a.txt", "is not a folder"),
        ("visdrone:{}?fsp=3", "unknown option 'fsp'"),
        ("visdrone:{}?fps=0", "says fps=0"),
        ("visdrone:{}?fps=fast", "says fps=fast"),
        ("still:{}?labels=some", "says labels=some"),
        ("still:{}?view=9", "says view=9"),
        ("still:{}", "holds no pictures"),
        ("clips:{}", "holds neither videos nor images"),
        ("uavdt:{}", "has no sequences"),
        ("mot:{}", "seqinfo.ini"),
        ("demo:", "asks for the seeds ''"),
        ("demo:5-1", "asks for the seeds '5-1'"),
        ("demo:0-99999999", "at most 10000"),
        ("demo:-1", "asks for the seeds"),
    ],
)
def test_a_wrong_uri_is_one_sentence(tmp_path, uri, said):
    """A slip of the pen is told with what is accepted."""
    (tmp_path / "a.txt").write_text("")
    with pytest.raises(UserError, match=said.replace("?", r"\?")):
        open_dataset(uri.format(tmp_path))


def test_pictures_alone(tmp_path):
    """Test sets are published without annotations; reference labels need none."""
    write_visdrone(tmp_path, "a")
    shutil.rmtree(tmp_path / "annotations")
    (sequence,) = open_dataset(f"visdrone:{tmp_path}?labels=none")
    assert sequence.labels is None
    assert sequence.labels_at(0) is None
    assert len(list(sequence.clip.images())) == 3


def test_uavdt_labels(tmp_path):
    """Classes come from _gt_whole, regions from _gt_ignore, attributes from M_attr, wherever they were unpacked."""
    write_uavdt(tmp_path)
    (sequence,) = open_dataset(f"uavdt:{tmp_path}")
    assert (sequence.name, sequence.frame_count, sequence.fps) == ("M0203", 6, 30)
    assert sequence.class_set == ("bus", "car", "truck")
    assert sequence.attributes == {"weather": "fog", "altitude": "low", "view": "side, bird"}
    labels = sequence.labels(2)
    assert labels.boxes_xyxy_px.tolist() == [xyxy(*square_xywh(2))]
    assert (labels.class_names, labels.ids.tolist()) == (("bus",), [1])
    assert labels.ignored_xyxy_px.tolist() == [[100, 0, 160, 20], [0, 0, 30, 10]], "both, of one number"


@pytest.mark.parametrize("case", [str.upper, str.lower])
@pytest.mark.parametrize("scheme", ["visdrone", "uavdt", "mot"])
def test_folders_and_files_may_have_names_in_any_case(tmp_path, scheme, case):
    """A disk that knows no case loses it: a whole set was not found, and UAVDT's regions were objects of nobody."""
    root = tmp_path / "set"
    write = {"visdrone": write_visdrone, "uavdt": write_uavdt, "mot": write_mot}[scheme]
    write(root / "S1" if scheme == "mot" else root, *(["a"] if scheme == "visdrone" else []))
    (before,) = open_dataset(f"{scheme}:{root}")
    truth = [before.labels(index) for index in range(6)]
    for path in sorted(root.rglob("*"), reverse=True):
        path.rename(path.with_name(case(path.name)))
    (after,) = open_dataset(f"{scheme}:{root}")
    assert (after.name.lower(), after.attributes) == (before.name.lower(), before.attributes)
    for one, index in zip(truth, range(6), strict=True):
        now = after.labels(index)
        assert now.boxes_xyxy_px.tolist() == one.boxes_xyxy_px.tolist()
        assert now.passed_xyxy_px.tolist() == one.passed_xyxy_px.tolist()


def test_uavdt_without_classes_or_regions(tmp_path):
    """The tracking truth alone says where vehicles are, not which."""
    write_uavdt(tmp_path, whole=False)
    (tmp_path / "UAV-benchmark-MOTD_v1.0" / "GT" / "M0203_gt_ignore.txt").unlink()
    (sequence,) = open_dataset(f"uavdt:{tmp_path}")
    assert sequence.class_set == ("vehicle",)
    assert sequence.labels(0).class_names == ("vehicle",)
    shutil.rmtree(tmp_path / "UAV-benchmark-MOTD_v1.0")
    with pytest.raises(UserError, match=r"M0203_gt_whole\.txt"):
        open_dataset(f"uavdt:{tmp_path}")


@pytest.mark.realdata
def test_uavdt_real_annotations(tmp_path, data):
    """The published files, to the last line."""
    write_images(tmp_path / "M0402", 30, name="img{:06d}.png")
    picture = np.zeros((540, 1024, 3), np.uint8)
    for file in (tmp_path / "M0402").iterdir():
        cv2.imwrite(str(file), picture)
    for file in (data / "uavdt").glob("M0402_*.txt"):
        shutil.copy(file, tmp_path)
    (sequence,) = open_dataset(f"uavdt:{tmp_path}")
    assert sequence.attributes == {"annotated beyond": "frame 410 of 30"}
    whole = np.loadtxt(data / "uavdt" / "M0402_gt_whole.txt", delimiter=",")
    for index in range(30):
        rows = whole[whole[:, 0] == index + 1]
        labels = sequence.labels(index)
        assert labels.ids.tolist() == rows[:, 1].tolist()
        assert set(labels.class_names) == {"car"}
        assert np.allclose(labels.boxes_xyxy_px[:, :2], rows[:, 2:4])
    table = sequence.labels.table()
    assert (len(table.frames), len(table.ignored.frames)) == (10210, 754)


def test_mot_labels(tmp_path):
    """Pixels count from 1 there; MOTA, IDF1 and HOTA are the published ones only if the same things count."""
    write_mot(tmp_path / "train" / "MOT17-02")
    (sequence,) = open_dataset(f"mot:{tmp_path}")
    assert (sequence.name, sequence.fps, sequence.frame_count) == ("MOT17-02", 25, 6)
    assert sequence.class_set == ("pedestrian",)
    labels = sequence.labels(1)
    assert labels.boxes_xyxy_px.tolist() == [xyxy(*square_xywh(1))]
    assert labels.ids.tolist() == [4]
    rows = read_truth_rows(tmp_path / "train" / "MOT17-02" / "gt" / "gt.txt", ["x"] * 13)
    (scored, *_) = rows.boxes[rows.frames == 2].tolist()
    assert scored == xyxy(*square_xywh(1)), "hvt-study score had its truth a pixel beside"
    assert labels.ignored_xyxy_px.shape == (0, 4)
    assert labels.beside_xyxy_px.tolist() == [[30, 10, 39, 19]]  # a distractor, not the car or the occluder
    assert [sequence.source_frame(frame_index) for frame_index in range(sequence.clip_frames)] == [0, 1, 3, 5]
    assert open_dataset(f"mot:{tmp_path / 'train' / 'MOT17-02'}")[0].name == "MOT17-02"


@pytest.mark.parametrize(
    ("first_image", "frames", "said"),
    [
        (1, 0, "has images 1 to 6, and its annotations are of frames 0 to 5"),
        (0, 1, "has images 0 to 5, and its annotations are of frames 1 to 6"),
        (
            4,
            1,
            "has images 4 to 9, and its annotations are of frames 1 to 6",
        ),  # a part, whose labels begin anew
        (4, "10,1,20,20,9,9,1,1,1\n", "has images 4 to 9, and its annotations are of frames 10 to 10"),
        (1, "1,1,.2,.2,.1,.1,1,1,1\n", r"gt\.txt has boxes of 0 to 1"),
    ],
)
def test_labels_that_count_frames_or_pixels_otherwise_than_images_are_refused(
    tmp_path, first_image, frames, said
):
    """Trackers write so (ByteTrack#417), and every label would be a frame late."""
    write_mot(tmp_path / "MOT17-02", rows=frames if isinstance(frames, str) else None)
    truth, images = tmp_path / "MOT17-02" / "gt" / "gt.txt", tmp_path / "MOT17-02" / "img1"
    if frames == 0:
        rows = [line.split(",", 1) for line in truth.read_text().splitlines()]
        truth.write_text("".join(f"{int(frame) - 1},{rest}\n" for frame, rest in rows))
        with pytest.raises(UserError, match="accepted is a frame number from 1 on"):
            read_truth_rows(truth, ["x"] * 13)
    shutil.rmtree(images)
    write_images(images, 6, name="{:06d}.png", first=first_image)
    with pytest.raises(UserError, match=said):
        open_dataset(f"mot:{tmp_path}")


@pytest.mark.parametrize(("name", "beside"), [("MOT17-02", (2, 7, 8, 12)), ("MOT20-01", (2, 6, 7, 8, 12))])
def test_mot_goes_by_trackeval(tmp_path, name, beside):
    """A pedestrian before a car, and what is marked as not counting, would be judged otherwise than by others."""
    every = [f"1,{kind},{10 * kind + 1},11,9,9,{int(kind == 1)},{kind},1\n" for kind in range(1, 14)]
    write_mot(tmp_path / name, rows="".join([*every, "1,99,1,51,9,9,0,1,1\n"]))
    (sequence,) = open_dataset(f"mot:{tmp_path}")
    labels = sequence.labels(0)
    assert (labels.ids.tolist(), sequence.class_set) == ([1], ("pedestrian",))
    assert labels.beside_xyxy_px[:, 0].tolist() == [10 * kind for kind in beside if 10 * kind < SIZE[0]]
    assert labels.paired
    assert labels.ignored_xyxy_px.shape == (0, 4)


@pytest.mark.parametrize("place", ["-1,-1,-1", "4.4852,5.5016,0", "12,3.3,0"])
def test_mot15_has_no_classes(tmp_path, place):
    """Where later sequences have class and visibility stands a place in the world, which may look like a class."""
    write_mot(tmp_path / "a", rows=f"1,1,11,11,9,9,1,{place}\n1,2,31,11,9,9,0,{place}\n")
    (sequence,) = open_dataset(f"mot:{tmp_path}")
    labels = sequence.labels(0)
    assert labels.class_names == sequence.class_set == ("pedestrian",)
    assert (labels.ids.tolist(), len(labels.beside_xyxy_px)) == ([1], 0)


@pytest.mark.realdata
@pytest.mark.parametrize(("name", "count"), [("TUD-Campus", 359), ("TUD-Stadtmitte", 1156)])
def test_real_mot15_annotations(data, name, count):
    """The very files whose MOTA and IDF1 are published."""
    truth = data / "tracking" / "motmetrics_tud" / name / "gt.txt"
    table = mot_table(truth, truth.with_name("labels.txt"), (640, 480))
    assert table.class_set == ("pedestrian",)
    assert len(table.frames) == len(truth.read_text().splitlines()) == count
    assert len(table.ignored.frames) == 0


def test_an_id_is_one_object_of_a_frame(tmp_path, caplog):
    """A row that tools have doubled would be an object that nobody can find."""
    late = 1_700_000_000_123  # the milliseconds at which it began
    rows = "".join(f"1,{number},{left},11,9,9,1,1,1\n" for number, left in ((1, 11), (1, 11), (late, 31)))
    write_mot(tmp_path / "a", rows=rows)
    (sequence,) = open_dataset(f"mot:{tmp_path}")
    assert sequence.labels(0).ids.tolist() == [1, late]
    assert "1 of 3 lines are left out" in caplog.text
    for nobody in (-1, 0):
        write_mot(tmp_path / "a", rows="".join(f"1,{nobody},{x},11,9,9,1,1,1\n" for x in (11, 31)))
        (sequence,) = open_dataset(f"mot:{tmp_path}")
        assert sequence.labels(0).ids.tolist() == [NO_ID] * 2
        assert not sequence.one_target, "nobody knows which object is which"


def test_mot_of_others(tmp_path):
    """CVAT writes names of its own, and says nothing of the frame rate."""
    write_mot(tmp_path / "a", rows="1,1,11,11,9,9,1,2,1,\n1,2,31,11,9,9,0,1,1\n")
    (tmp_path / "a" / "gt" / "labels.txt").write_text("tractor\nlorry\n")
    (tmp_path / "a" / "seqinfo.ini").unlink()
    with pytest.raises(UserError, match=r"a has no seqinfo\.ini, which says the frame rate: .*\?fps=25"):
        open_dataset(f"mot:{tmp_path}")
    (sequence,) = open_dataset(f"mot:{tmp_path}?fps=10")
    labels = sequence.labels(0)
    assert (sequence.name, sequence.fps, labels.class_names) == ("a", 10, ("lorry",))
    assert labels.beside_xyxy_px.tolist() == [[30, 10, 39, 19]]
    assert not labels.paired
    assert sequence.class_set == ("lorry", "tractor")
    shutil.rmtree(tmp_path / "a" / "gt")
    assert open_dataset(f"mot:{tmp_path}?fps=10&labels=none")[0].labels is None
    shutil.rmtree(tmp_path / "a" / "img1")
    with pytest.raises(UserError, match=r"has no sequence with a seqinfo\.ini or gt/gt\.txt"):
        open_dataset(f"mot:{tmp_path}?fps=10")


@pytest.mark.parametrize(
    ("named", "said"),
    [
        ({"info": "[Sequence]\nframeRate=0\n"}, "frameRate=0"),
        ({"info": "frameRate=25\n"}, r"expected is a section \[Sequence\]"),
        ({"info": "[Sequence]\nframeRate=25\nseqLength=9\n"}, "says seqLength=9 and has 6 images"),
        ({"info": "[Sequence]\nframeRate=25\nimDir=frames\n"}, "no folder frames"),
        # Of images that were made smaller the boxes lie elsewhere, and recall is 0 without a word.
        (
            {"info": f"[Sequence]\nframeRate=25\nimWidth={2 * SIZE[0]}\n"},
            f"says imWidth={2 * SIZE[0]}, and its images are {SIZE[0]} pixels wide",
        ),
        ({"rows": "1,1,1,1,9,9,1,4,0,1\n"}, "has VisDrone's ten columns"),
        ({"rows": "1,1,1,1,9,9,1,99,1\n"}, "line 1 is '1,1,1,1,9,9,1,99,1'"),
        ({"rows": "1,1,1,1,9,9,1,4.5,1\n"}, "line 1 is .* a class from 1 to 13"),
    ],
)
def test_a_bad_mot_sequence_is_one_sentence(tmp_path, named, said):
    """File and value are named."""
    write_mot(tmp_path / "a", **named)
    with pytest.raises(UserError, match=said):
        open_dataset(f"mot:{tmp_path}")


def test_a_bad_mot_line_costs_itself(tmp_path, caplog):
    """A class that a tool has made up would end the study."""
    write_mot(tmp_path / "a", rows="1,1,1,1,9,9,1,1,1\n1,2,1,1,9,9,1,4.5,1\n1,x\n")
    (sequence,) = open_dataset(f"mot:{tmp_path}")
    assert len(sequence.labels(0)) == 1
    assert "line 2 is" in caplog.text
    assert "line 3 is" in caplog.text


def _write_video(path, count, *, fps):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=fps)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "bgr0"
        for picture in smooth_pictures(count, size=SIZE):
            frame = av.VideoFrame.from_ndarray(picture, format="bgr24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


@pytest.mark.parametrize(("ending", "fps"), [("mkv", 25), ("avi", 10), ("mkv", 30)])
def test_clips_say_what_a_frame_shows(tmp_path, ending, fps):
    """Reference labels are kept by source frame; those of another frame would be of another picture."""
    _write_video(tmp_path / f"road.{ending}", 24, fps=fps)
    (tmp_path / "notes.txt").write_text("no video")
    (tmp_path / f"._road.{ending}").write_text("a Mac's note on it")
    (sequence,) = open_dataset(f"clips:{tmp_path}")
    assert (sequence.name, sequence.frame_count, sequence.fps) == ("road", 24, fps)
    assert (sequence.labels, sequence.class_set) == (None, ())
    drawn = smooth_pictures(24, size=SIZE)
    pictures = list(sequence.clip.images())
    assert len(pictures) == sequence.clip_frames == -(-24 * 15 // fps)
    for frame_index, picture in enumerate(pictures):
        assert np.array_equal(picture, drawn[sequence.source_frame(frame_index)])
    (given,) = open_dataset(f"clips:{tmp_path}?fps={fps}")
    assert content_hash(given) != content_hash(sequence), "time stamps of that mean may show other frames"


def test_a_broken_clip_is_named(tmp_path):
    """One of fifty videos is always damaged."""
    (tmp_path / "road.mp4").write_bytes(b"not a video at all")
    with pytest.raises(UserError, match=r"road\.mp4"):
        open_dataset(f"clips:{tmp_path}")


@pytest.mark.realdata
def test_real_clips_play_as_many_pictures_as_promised(data):
    """A clip that ends early leaves frames without a picture in every table."""
    for sequence in open_dataset(f"clips:{data / 'clips'}", only=["intel*"]):
        assert (sequence.frame_count, sequence.fps, sequence.clip_frames) == (377, 12.5, 453)
        assert sum(1 for _ in sequence.clip.images()) == 453


def test_demo_seeds(monkeypatch):
    """Exact labels of the drawn scene: of the same picture that is flown."""
    first, last = open_dataset("demo:6-7")
    assert (first.name, last.name) == ("demo-6", "demo-7")
    labels, truth = last.labels(3), Scene(7).truth(3 / 15)
    asked = truth.visible >= 0.5
    assert np.array_equal(labels.boxes_xyxy_px, truth.boxes_source_px[asked])
    assert np.array_equal(labels.ids, truth.ids[asked])
    assert len(labels.ignored_xyxy_px) == 0
    assert len(labels.beside_xyxy_px) == (~asked).sum() > 0
    assert set(labels.class_names) <= set(last.class_set)
    assert (last.clip_frames, last.frame_count, last.source_frame(299)) == (300, 300, 299)

    def flown(spec, *, seed, **_):
        return Mock(frames=lambda start_ns: [Mock(source_bgr=(spec, seed))])

    monkeypatch.setattr("hvt_study.datasets.sequence.open_source", flown)
    assert list(last.clip.images()) == [("demo", 7)]


def test_demo_scenes_with_codes():
    """Codes are read against the very picture that is flown, and kept apart from the plain scene's results."""
    first, *_ = open_dataset("demo:1,codes")
    assert first.name == "demo-1-codes"
    drawn = Scene(1, codes=True).codes(2.0)
    assert [code.text for code in first.codes(30)] == [code.text for code in drawn]
    assert np.array_equal(first.codes(30)[0].corners_source_px, drawn[0].corners_source_px)
    (plain,) = open_dataset("demo:1")
    assert plain.codes is None
    assert content_hash(plain) != content_hash(first)
    (large,) = open_dataset("demo:codes,4k")
    assert (large.name, large.source_size) == ("demo-0-codes-4k", (3840, 2160))
    assert large.clip.spec == "demo:codes,4k"


def test_a_clip_is_staged_once(tmp_path):
    """Flights map the pixels in place of decoding them again; a full disk costs time, not the study."""
    write_visdrone(tmp_path / "root", "a")
    (sequence,) = open_dataset(f"visdrone:{tmp_path / 'root'}")
    staged = stage_clip(sequence.clip, tmp_path / "clip.bgr")
    assert staged.pixels == tmp_path / "clip.bgr"
    for one, other in zip(staged.images(), sequence.clip.images(), strict=True):
        assert np.array_equal(one, other)
    assert stage_clip(sequence.clip, tmp_path / "/dev/full") == sequence.clip


def test_the_content_of_a_sequence(tmp_path):
    """A result names what it was measured on: the same wherever it lies, another for another label, read anew."""
    for name in ("one", "two"):
        write_visdrone(tmp_path / name, "a", rows="1,1,0,0,9,9,1,4,0,0\n")
    first, second = (open_dataset(f"visdrone:{tmp_path / name}")[0] for name in ("one", "two"))
    assert content_hash(first) == content_hash(second)
    assert second.labels(0).class_names == ("car",)
    (tmp_path / "two" / "annotations" / "a.txt").write_text("1,1,0,0,9,9,1,6,0,0\n1,2,0,0,9,9,1,6,0,0\n")
    assert content_hash(first) != content_hash(second)
    assert second.labels(0).class_names == ("truck", "truck")


def test_lines_of_any_length_are_read_alike(tmp_path):
    """Columns beyond the known ones, and a comma at the end of some lines, are no matter, nor is a remark above."""
    path = tmp_path / "a.txt"
    path.write_text("# mine\n1,2,3\n4,5,6,\n7,8,9,10\n\n")
    rows = read_rows(path, columns="frame,id,x", least=2, of_dataset=True)
    assert rows.table.tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
    assert rows["y"].tolist() == [-1, -1, -1]
    path.write_text("")
    assert len(read_rows(path, columns="frame,id,x", least=2)) == 0


@pytest.mark.parametrize(
    ("name", "b_frames", "times"), [("a.ts", "2", 2), ("a.h264", "0", 1), ("a.avi", "2", 1)]
)
def test_a_clip_plays_the_frames_that_its_sequence_names(tmp_path, name, b_frames, times):
    """Half of two put together was left out of a study, or reference labels stood a frame beside what was flown."""
    clip, count = write_numbered(tmp_path / name, 60, bf=b_frames), 60 * times
    clip.write_bytes(clip.read_bytes() * times)
    (sequence,) = open_dataset(f"clips:{clip}")
    assert sequence.frame_count == count
    told = [sequence.source_frame(index) for index in range(sequence.clip_frames)]
    assert told == list(range(0, count, 2))
    assert [number_of(picture) for picture in sequence.clip.images()] == [number % 60 for number in told]
