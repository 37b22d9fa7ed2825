"""Labels that are made: by a virtual camera over annotated pictures, and by a detector; which class means which."""

import pickle
import shutil
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from hvt_common.errors import UserError
from hvt_common.inference.class_names import COCO_NAMES, IMAGENET_NAMES, MOVING, VISDRONE_NAMES
from hvt_common.values import Posterior
from hvt_study.datasets.class_map import joint_classes, map_classes
from hvt_study.datasets.labels import covered_share
from hvt_study.datasets.layouts.uri import open_dataset
from hvt_study.datasets.reference import reference_labels, with_labels
from hvt_study.datasets.sequence import stage_clip
from hvt_study.datasets.virtual_camera import VirtualCamera, read_annotations
from hvt_study.metrics.classes import class_score
from hvt_study.metrics.judged import judged
from rigs.flight import RedSquares
from studies.layouts import SIZE, square_xywh, write_visdrone
from studies.metric_frames import labels, square, view

UAVDT, ANIMALS = ("bus", "car", "truck"), ("cat", "dog")
BLOCKS = [(300, 200, 40, 24), (620, 330, 30, 40), (480, 260, 24, 24)]
"""x, y, w, h of white blocks on dark ground."""


@pytest.fixture
def root(tmp_path):
    """VisDrone-DET: a picture with a car, a bus, and a pedestrian in a region that nobody has labelled."""
    pixels = np.full((540, 960, 3), 40, np.uint8)
    for x, y, w, h in BLOCKS:
        pixels[y : y + h, x : x + w] = 250
    lines = [
        f"{x},{y},{w},{h},1,{kind},0,{kind % 3}" for (x, y, w, h), kind in zip(BLOCKS, (4, 9, 1), strict=True)
    ]
    lines += ["470,250,60,60,0,0,0,0", "10,10,50,50,1,11,0,0"]
    for name in ("images", "annotations"):
        (tmp_path / name).mkdir()
    cv2.imwrite(str(tmp_path / "images" / "street.png"), pixels)
    (tmp_path / "annotations" / "street.txt").write_text("\n".join(lines))
    return tmp_path


def test_boxes_follow_the_camera_on_every_way(root):
    """Derived sequences are the only real labels here: a pixel of drift is a wrong label for a 10-pixel object."""
    sequences = open_dataset(f"still:{root}?seeds=0,1-3&view=0.6")
    assert [one.name for one in sequences] == [f"street-{seed}" for seed in range(4)]
    checked = 0
    for sequence in sequences:
        assert (sequence.attributes["view"], sequence.attributes["seed"]) == ("0.6", sequence.name[-1])
        for index, image in enumerate(sequence.clip.images()):
            if index % 35:
                continue
            labels = sequence.labels(index)
            ys, xs = np.nonzero(image[:, :, 0] > 145)
            for box in labels.boxes_xyxy_px:
                near = (xs > box[0] - 6) & (xs < box[2] + 6) & (ys > box[1] - 6) & (ys < box[3] + 6)
                found = xs[near].min(), ys[near].min(), xs[near].max() + 1, ys[near].max() + 1
                assert np.allclose(found, box, atol=1.01)
                checked += bool((box > 0).all() and (box[2:] < sequence.source_size).all())  # wholly inside
    assert checked > 20


def test_objects_enter_and_leave_and_keep_their_ids(root):
    """Tracks are judged by identity: an id that jumps to another object would count as the tracker's mistake."""
    (sequence,) = open_dataset(f"still:{root}?view=0.6")
    seen: dict[int, list[tuple[int, np.ndarray, str]]] = {}
    for index in range(sequence.frame_count):
        labels = sequence.labels(index)
        for number, box, name in zip(
            labels.ids.tolist(), labels.boxes_xyxy_px, labels.class_names, strict=True
        ):
            seen.setdefault(number, []).append((index, box, name))
    assert len(seen) >= 2
    for track in seen.values():
        assert len({name for _, _, name in track}) == 1
        for (before, one, _), (after, other, _) in pairwise(track):
            assert after > before + 1 or np.abs(one - other).max() < 12
    spans = [(track[0][0], track[-1][0]) for track in seen.values()]
    assert any(first > 0 for first, _ in spans)
    assert any(last < sequence.frame_count - 1 for _, last in spans)


def test_what_nobody_labelled_is_ignored(root):
    """The pedestrian lies in an ignored region: VisDrone's own toolkit does not ask for it."""
    (sequence,) = open_dataset(f"still:{root}")
    names = {name for index in range(0, 210, 10) for name in sequence.labels(index).class_names}
    assert names == {"car", "bus"}
    assert sequence.class_set == tuple(sorted(VISDRONE_NAMES))
    assert sum(len(sequence.labels(index).ignored_xyxy_px) for index in range(0, 210, 10)) > 10


def test_a_seed_is_a_way(root):
    """The same seed flies the same pixels anywhere; another sees the picture anew."""
    again = VirtualCamera(root / "images" / "street.png", seed=2)
    (sequence,) = open_dataset(f"still:{root}?seeds=2")
    sequence = pickle.loads(pickle.dumps(sequence))
    pairs = zip(islice(sequence.clip.images(), 3), again.images(), strict=False)
    assert all(np.array_equal(one, other) for one, other in pairs)
    staged = stage_clip(sequence.limited(3).clip, root / "clip.bgr")  # as flights play it
    assert all(map(np.array_equal, staged.images(), again.images()))
    assert staged.pixels
    plain = VirtualCamera(root / "images" / "street.png")
    assert not np.array_equal(next(plain.images()), next(again.images()))


def test_each_folder_of_a_set_is_listed_once(root, monkeypatch):
    """A set of thousands would take a listing of them all for each of its pictures, and each of their frames."""
    listed, iterdir = [], Path.iterdir
    monkeypatch.setattr(Path, "iterdir", lambda folder: (listed.append(folder), iterdir(folder))[1])
    for number in range(12):
        for folder, name in (("images", "png"), ("annotations", "txt")):
            shutil.copy(root / folder / f"street.{name}", root / folder / f"{number}.{name}")
    sequences = open_dataset(f"still:{root}")
    assert [one.labels(0) for one in sequences]
    assert listed.count(root / "images") < len(sequences) == 13


def test_a_folder_of_pictures_with_annotations_beside(root):
    """Whoever annotates a handful of pictures needs no layout; but one that is forgotten is told."""
    flat = root / "flat"
    flat.mkdir()
    shutil.copy(root / "images" / "street.png", flat)
    shutil.copy(root / "annotations" / "street.txt", flat)
    (sequence,) = open_dataset(f"still:{flat}")
    assert sequence.labels(100).class_names
    (alone,) = open_dataset(f"still:{flat / 'street.png'}")
    assert alone.name == "street"
    shutil.copy(flat / "street.png", flat / "second.png")
    with pytest.raises(UserError, match=r"second\.txt of picture second\.png"):
        open_dataset(f"still:{flat}")
    assert [one.labels for one in open_dataset(f"still:{flat}?labels=none")] == [None, None]
    (flat / "street.txt").write_text("\n\n1,2,3\n")
    with pytest.raises(UserError, match=r"street\.txt, line 3"):
        open_dataset(f"still:{flat / 'street.png'}")


@pytest.mark.realdata
def test_a_real_picture_with_its_annotations(tmp_path, data):
    """VisDrone's own files as they are published."""
    name = "0000001_02999_d_0000005"
    for folder, ending in (("images", "jpg"), ("annotations", "txt")):
        (tmp_path / folder).mkdir()
        shutil.copy(data / "visdrone" / f"{name}.{ending}", tmp_path / folder)
    (sequence,) = open_dataset(f"still:{tmp_path}")
    assert (sequence.name, sequence.source_size, sequence.frame_count) == (name, (1670, 938), 210)
    rows = np.loadtxt(data / "visdrone" / f"{name}.txt", delimiter=",")
    middle = sequence.labels(105)
    # Half-way the camera sees the middle of the picture, which is nearly all of it, and little of its images.
    assert 0.8 * (rows[:, 5] > 0).sum() < len(middle) <= (rows[:, 5] > 0).sum()
    assert {"car", "pedestrian", "motor"} <= set(middle.class_names)


@pytest.mark.realdata
def test_two_hundred_real_annotations(data):
    """Categories, scores and commas as the annotators left them."""
    files = sorted((data / "visdrone" / "annotations").glob("*.txt"))
    found = [read_annotations(file, (10_000, 10_000))[0] for file in files]
    assert len(files) == 200
    # 12330 objects by their categories, of which a few lie in ignored regions or are empty.
    assert 12_000 < sum(len(one.class_names) for one in found) <= 12_330
    assert sum(len(one.ignored_xyxy_px) for one in found) == 550  # category 0
    assert sum(len(one.beside_xyxy_px) for one in found) == 12  # category 11, "others"


def test_covered_share_counts_nothing_twice():
    """Overlapping regions must not hide an object between them that they do not cover."""
    boxes = np.array([[0, 0, 10, 10], [5, 5, 15, 15], [100, 100, 110, 110]], np.float32)
    regions = np.array([[0, 0, 6, 10], [4, 0, 8, 10], [14, 14, 40, 40]], np.float32)
    assert covered_share(boxes, regions) == pytest.approx([0.8, (3 * 5 + 1) / 100, 0])
    assert covered_share(boxes, regions[:0]).tolist() == [0, 0, 0]
    rng = np.random.default_rng(0)
    corners = rng.integers(0, 40, (40, 2, 2)).astype(np.float32)
    many = np.concatenate([corners.min(axis=1), corners.max(axis=1) + 1], axis=1)
    grid = np.zeros((41, 41), bool)
    for x1, y1, x2, y2 in many[:9].astype(int):
        grid[y1:y2, x1:x2] = True
    wanted = [grid[y1:y2, x1:x2].mean() for x1, y1, x2, y2 in many[9:].astype(int)]
    assert covered_share(many[9:], many[:9]) == pytest.approx(wanted)


SPOKEN: dict[str, Any] = {
    # A van that the detector names is a car where the dataset knows no vans.
    "VisDrone on UAVDT": (
        *(VISDRONE_NAMES, UAVDT, {"car": ("car",), "van": ("car",), "truck": ("truck",), "bus": ("bus",)}),
        {"van": "car", "bus": "bus", "pedestrian": "pedestrian"},  # which is nobody's partner
    ),
    # COCO cannot tell pedestrians from people, nor vans from cars: it must not be judged as if it could.
    "COCO on VisDrone": (
        *(COCO_NAMES, VISDRONE_NAMES, {"person": ("pedestrian", "people")}),
        {
            **dict.fromkeys(("person", "pedestrian", "people"), "person"),
            "car": "car",
            "van": "car",
            "motorcycle": "motor",
            "motor": "motor",
        },
    ),
    "its own": (VISDRONE_NAMES, sorted(VISDRONE_NAMES), {name: (name,) for name in VISDRONE_NAMES}, {}),
    # A classifier speaks of vehicles in hundreds of words.
    "ImageNet on UAVDT": (
        *(IMAGENET_NAMES, UAVDT, {"minivan": ("car",), "sports car": ("car",), "pickup": ("truck",)}),
        {"minivan": "car"},
    ),
    # A dataset of vehicles and a detector of what moves are compared in the one word that they have.
    "COCO on vehicles": (
        *(COCO_NAMES, ("vehicle",), {"car": ("vehicle",), "bus": ("vehicle",), "truck": ("vehicle",)}),
        {"bus": "vehicle", "vehicle": "vehicle"},
    ),
    "what moves": ((MOVING,), VISDRONE_NAMES, {MOVING: VISDRONE_NAMES}, {"bus": MOVING, MOVING: MOVING}),
}


@pytest.mark.parametrize("case", SPOKEN)
def test_a_models_words_and_a_datasets(case):
    """A model would be judged by what it cannot tell apart, or not by what it can."""
    models, classes, spoken, words = SPOKEN[case]
    found = map_classes(models, classes)
    assert {name: found.spoken[name] for name in spoken} == spoken
    assert {name: found.word(name) for name in words} == words
    counts = {"VisDrone on UAVDT": 4, "its own": 10, "COCO on vehicles": 3, "what moves": 1}
    assert len(found.spoken) < 100
    assert len(found.spoken) == counts.get(case, len(found.spoken))
    if case == "VisDrone on UAVDT":
        assert ("pedestrian" in found.words, found.classes) == (False, UAVDT)
    if case == "COCO on VisDrone":
        assert set(VISDRONE_NAMES) - set(found.words) == {"awning-tricycle", "tricycle"}
    if case == "its own":
        assert found.classes == tuple(sorted(VISDRONE_NAMES))


def test_a_right_still_is_right_in_whatever_words():
    """Every still that an ImageNet classifier names rightly would count as an error that the hybrids made."""
    found = joint_classes(VISDRONE_NAMES, IMAGENET_NAMES, UAVDT)
    truth = labels((square(0), "car"), (square(100), "truck"), (square(200), "car"))
    shown = view(
        (square(0), "minivan", 1, 0.9, "bus"),
        (square(100), "pickup", 2, 0.9, "truck"),
        (square(200), "van", 3, 0.9, "van"),
    )
    frames = judged([(truth, shown)], word=found.word, classes=found.classes)
    after, before = class_score(frames), class_score(frames, refined=False)
    assert (after.counts.right, before.counts.right, after.counts.top1_all) == (3, 2, 1.0)


def test_what_one_model_cannot_tell_apart_is_asked_of_neither():
    """The finer of two models would be punished for being fine, or the coarser for what it cannot know."""
    same = joint_classes(VISDRONE_NAMES, VISDRONE_NAMES, VISDRONE_NAMES)
    assert (same.word("car"), same.word("van")) == ("car", "van")
    for detector, reader in ((VISDRONE_NAMES, IMAGENET_NAMES), (COCO_NAMES, VISDRONE_NAMES)):
        found = joint_classes(detector, reader, VISDRONE_NAMES)
        assert {found.word(name) for name in ("car", "van")} == {"car"}, detector
    found = joint_classes(VISDRONE_NAMES, IMAGENET_NAMES, VISDRONE_NAMES)
    assert found.spoken["minivan"] == found.spoken["van"] == ("car", "van")
    assert (found.word("pedestrian"), found.word("people")) == ("pedestrian", "people")  # ImageNet has none
    # The labels that are asked for are the detector's: the same video is worth as much beside a finer classifier.
    read = joint_classes(COCO_NAMES, IMAGENET_NAMES, VISDRONE_NAMES)
    assert read.classes == joint_classes(COCO_NAMES, None, VISDRONE_NAMES).classes
    assert "tricycle" not in read.classes
    # With reference labels a still that repeats its classifier's very word is right.
    found = joint_classes(VISDRONE_NAMES, IMAGENET_NAMES, IMAGENET_NAMES)
    assert found.word("minivan") == found.word("beach wagon") == found.word("van") == "car"


@pytest.mark.parametrize(
    ("map_them", "names"),
    [
        *((map_classes, names) for names in ((ANIMALS, VISDRONE_NAMES), (COCO_NAMES, ()), ((), ("car",)))),
        (joint_classes, (VISDRONE_NAMES, ANIMALS, UAVDT)),
    ],
)
def test_label_sets_that_do_not_map(map_them, names):
    """Hours of flights with a score of nothing would be the answer to a wrong model."""
    with pytest.raises(UserError, match="have nothing in common") as caught:
        map_them(*names)
    assert "\n" not in str(caught.value)


class Namer:
    """A classifier that tells by the size of the crop."""

    class_names = ("small", "large, big")

    def classify(self, crops):
        kinds = [int(crop.shape[0] > 40) for crop in crops]
        certain = np.eye(2, dtype=np.float32)
        return [Posterior(self.class_names[kind], 1.0, 0.0, certain[kind]) for kind in kinds]


def test_reference_labels_are_in_source_pixels(tmp_path):
    """Labels in another space than the ground's list would score nothing."""
    write_visdrone(tmp_path, "a", count=12)
    (sequence,) = open_dataset(f"visdrone:{tmp_path}?labels=none&fps=10")
    made = reference_labels(sequence, detector=RedSquares())
    assert sorted(made.frames) == list(range(12))
    labelled = pickle.loads(pickle.dumps(with_labels(sequence, made)))
    for frame_index in (0, 1, 9):
        labels = labelled.labels_at(frame_index)
        x, y, w, h = square_xywh(sequence.source_frame(frame_index))
        assert np.abs(labels.boxes_xyxy_px - [x, y, x + w, y + h]).max() <= 1
        assert labels.ids.tolist() == [-1]
    assert set(labels.class_names) <= set(labelled.class_set) == set(RedSquares().class_names)
    # The same at the size of the base.
    large = reference_labels(sequence, detector=RedSquares(), size=(2 * SIZE[0], 2 * SIZE[1]))
    assert sorted(large.frames) == sorted(made.frames)
    assert np.abs(large(5).boxes_xyxy_px - made(5).boxes_xyxy_px).max() <= 1


def test_a_classifier_names_the_boxes(tmp_path):
    """Refinement by a classifier is judged by that classifier's word on the untouched crop."""
    write_visdrone(tmp_path, "a")
    (sequence,) = open_dataset(f"visdrone:{tmp_path}?labels=none")
    made = reference_labels(sequence, detector=RedSquares(), classifier=Namer())
    assert made(0).class_names == ("large",)  # 32 pixels and the margin of a still
    assert made.class_set == ("large", "small")
