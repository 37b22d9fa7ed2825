"""A user's own objects: labels in, an ONNX file out that knows them. What needs PyTorch is skipped without it."""

import json

import cv2
import numpy as np
import pytest

from hvt_common.inference.detect import open_detector
from hvt_common.inference.runtimes.model import open_model
from hvt_common.inference.store import EMBEDDED_DETECTOR, embedded_models
from hvt_common.values import iou
from hvt_study.cli import main

NAMES = ("buoy", "boat", "person")
SIZE = (320, 192)


def paint(rng):
    """A picture of water with a bright buoy and a dark boat, and their boxes (class, x1, y1, x2, y2)."""
    water = cv2.resize(rng.integers(70, 110, (24, 40, 3), np.uint8), SIZE)
    boxes = []
    for kind, (wide, high), colour in ((0, (28, 28), (40, 90, 250)), (1, (72, 40), (15, 15, 15))):
        x = int(rng.integers(10, SIZE[0] - wide - 10)) if kind == 0 else int(rng.integers(10, 230))
        y = int(rng.integers(8, 60)) if kind == 0 else int(rng.integers(100, 140))
        cv2.rectangle(water, (x, y), (x + wide - 1, y + high - 1), colour, -1)
        boxes.append((kind, x, y, x + wide, y + high))
    return np.asarray(water, np.uint8), boxes


@pytest.fixture
def water(tmp_path):
    """A YOLO folder of 12 pictures."""
    folder = tmp_path / "water"
    (folder / "images").mkdir(parents=True)
    (folder / "labels").mkdir()
    (folder / "classes.txt").write_text("\n".join(NAMES) + "\n")
    rng = np.random.default_rng(2)
    for number in range(12):
        image, boxes = paint(rng)
        cv2.imwrite(str(folder / f"images/{number:02d}.png"), image)
        rows = [
            f"{kind} {(x1 + x2) / 640} {(y1 + y2) / 384} {(x2 - x1) / 320} {(y2 - y1) / 192}\n"
            for kind, x1, y1, x2, y2 in boxes
        ]
        (folder / f"labels/{number:02d}.txt").write_text("".join(rows))
    return folder


@pytest.fixture
def start(tmp_path):
    """The network before anything was learnt, as a file of COCO-like classes."""
    torch = pytest.importorskip("torch")
    pytest.importorskip("onnx")
    from hvt_train.learning.detector import DetectorNet
    from hvt_train.learning.train_detector import export_detector

    torch.manual_seed(0)
    torch.set_num_threads(1)
    path, net = tmp_path / "start.onnx", DetectorNet(3).eval()
    for layer in net.modules():  # equal ones would be stored once
        if isinstance(layer, torch.nn.BatchNorm2d):
            layer.running_mean.normal_(0, 0.05)
        elif getattr(layer, "bias", None) is not None:
            torch.nn.init.normal_(layer.bias, layer.bias.detach().mean().item(), 0.01)
    export_detector(net, path, properties={"names": "['person', 'car', 'boat']"})
    return path


def test_a_network_learns_what_it_never_knew(tmp_path):
    """An hour of training would end in a file that finds nothing."""
    pytest.importorskip("torch")
    pytest.importorskip("onnx")
    from hvt_train.fine_tune import FineTuneSettings, fill_own, fine_tune
    from hvt_train.pictures.places import Picture
    from hvt_train.pictures.real import HeldOut

    rng = np.random.default_rng(5)

    def pictures(count):
        for _ in range(count):
            image, rows = paint(rng)
            table = np.array(rows, np.float32)
            yield Picture(image, table[:, 1:], table[:, 0].astype(np.int32), np.ones(2, np.float32))

    kept = list(pictures(4))
    nothing = np.zeros((0, 4), np.float32)

    def held_out():
        return [HeldOut(one.image_bgr, one.boxes_px, nothing, frozenset(NAMES)) for one in kept]

    def found(path):
        """Share of labels that a box of the class lies on, however low its calibrated score."""
        detector = open_detector(str(path), confidence=1e-9)
        hits = []
        for one in kept:
            seen = detector.detect(one.image_bgr)
            same = seen.class_ids[:, None] == one.class_ids[None]
            hits += ((iou(seen.boxes_xyxy_px, one.boxes_px) >= 0.5) & same).any(axis=0).tolist()
        return float(np.mean(hits))

    out, told = tmp_path / "buoys.onnx", []
    tuned = fine_tune(
        fill_own(tmp_path / "pool", pictures(10), seed=1),
        held_out,
        classes=NAMES,
        start=embedded_models()[EMBEDDED_DETECTOR],
        out=out,
        settings=FineTuneSettings(
            steps=100, budget_s=600, check_every=20, batch=4, side=128, rate=2e-3, threads=1
        ),
        measure=found,
        on_step=lambda step, quality: told.append((step, quality)),
    )
    measured = [quality for _, quality in told if quality is not None]
    assert max(measured) == found(out) >= 0.75, told
    assert told[-1][0] == tuned.steps == 100
    assert open_detector(str(out)).class_names == NAMES
    metadata, fitted = open_model(out).metadata, tuned.calibration
    if fitted is None:  # every box is right: there is nothing to fit
        assert "hvt.calibration" not in metadata
    else:
        assert metadata["hvt.calibration"] == f"{fitted.slope:.4f} {fitted.shift:.4f}"
        assert metadata["hvt.confidence"] == f"{fitted.confidence:.2f}"


def test_the_command_writes_a_file_that_a_detector_takes(tmp_path, start, water, capsys):
    """A user would have to put the parts of the trainer together by hand."""
    (water / "images" / "broken.png").write_bytes(b"no picture")
    (water / "labels" / "broken.txt").write_text("")
    cv2.imwrite(str(water / "images" / "unlabelled.png"), np.zeros((20, 20, 3), np.uint8))
    out = tmp_path / "boat.onnx"
    (tmp_path / "boat.pool").mkdir()  # it is nobody's but the user's
    words = [
        "train",
        "--data",
        f"yolo:{water}",
        "--start",
        str(start),
        "--out",
        str(out),
        "--size",
        "320x192",
    ]
    assert main([*words, "--steps", "2"]) == 0
    said = capsys.readouterr()
    for text in (
        "broken.png cannot be read as a picture; skipped",
        "1 of 13 pictures skipped",
        "1 pictures of",
    ):
        assert text in said.err
    held = "10 pictures to train on, 2 held out"
    for text in (held, "person: 0 and 0 objects; it cannot be learnt", "--detector"):
        assert text in said.out
    assert open_detector(str(out)).class_names == NAMES
    about = json.loads(out.with_suffix(".json").read_text())
    assert (about["trained_on"], about["held_out"], about["steps"]) == (10, 2, 2)
    assert about["classes"] == list(NAMES)
    assert about["after"]["by_class"]["buoy"]["labels"] == 2
    assert "buoy" not in about["before"]["by_class"]  # nobody knew it
    assert out.with_suffix(".jsonl").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        *("boat.json", "boat.jsonl", "boat.onnx", "boat.pool", "start.onnx", "water")
    ]


def test_another_network_is_no_start(tmp_path, water, capsys):
    """An error of a tensor's shape in place of what --start takes."""
    pytest.importorskip("torch")
    pytest.importorskip("onnx")
    from media.onnx_models import colour_detector

    other = colour_detector(tmp_path / "other.onnx", "yolox")
    words = ["--start", str(other), "--out", str(tmp_path / "b.onnx"), "--size", "320x192"]
    assert main(["train", "--data", f"yolo:{water}", *words]) == 2
    assert "is not of aerial-nano's network" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["other.onnx", "water"]


def test_what_cannot_be_is_one_sentence(tmp_path, water, capsys):
    """Nothing is worse than an hour of training whose file cannot be written."""
    pytest.importorskip("torch")
    pytest.importorskip("onnx")
    empty, own = tmp_path / "empty", f"yolo:{water}"
    empty.mkdir()
    ours = ("--data", own, "--out", tmp_path / "b.onnx")
    none = "the pictures to train on have no labelled object"  # it would be measured on what it learnt
    for words, said in (
        ((*ours, "--data", water), "yolo:FOLDER or coco:FILE.json is"),
        ((*ours, "--data", f"yolo:{empty}"), "holds no pictures"),
        ((*ours, "--data", f"coco:{tmp_path}/none.json"), "COCO's JSON is expected"),
        ((*ours, "--out", tmp_path / "b.pt"), "name ends with .onnx"),
        ((*ours, "--out", tmp_path / "no/b.onnx"), "there is no folder"),
        ((*ours, "--minutes", "0"), "--minutes 0.0 is not accepted"),
        ((*ours, "--start", "aerial-nan"), "start 'aerial-nan' is not known"),
        ((*ours, "--held-out", own), none),
        (ours, "--data has 4 labelled pictures that can be read: 10 are needed"),
    ):
        if words == ours:
            for path in sorted((water / "labels").iterdir())[4:]:
                path.unlink()
        assert main(["train", *map(str, words)]) == 2
        err = capsys.readouterr().err
        assert said in err.splitlines()[-1]
        assert "Traceback" not in err
