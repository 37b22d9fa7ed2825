"""Training of the embedded models: pictures, labels, loss, export. What needs PyTorch is skipped without it."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from hvt_train.__main__ import main
from hvt_train.evaluate import average_precision, evaluate_drawn, evaluate_real
from hvt_train.pictures.fleet import make_solid
from hvt_train.pictures.places import Picture, draw_place
from hvt_train.pictures.pool import PoolPlan, fill_pool, shoot
from hvt_train.pictures.views import ViewSettings, ViewSource, degrade
from rigs.examples import detections

CLASSES = ("car", "van", "truck", "bus", "motor", "pedestrian", "other")


@pytest.fixture(scope="module")
def place():
    return draw_place(np.random.default_rng(3), size=512)


def save(folder, picture, name="place-00000"):
    path = folder / f"{name}.npz"
    shown = {"boxes": picture.boxes_px, "classes": picture.class_ids, "visible": picture.visible}
    np.savez(path, image=picture.image_bgr, **shown)
    return path


def test_a_place_is_the_same_every_time_and_its_boxes_are_in_it(place):
    """A training set could not be made again, or would teach boxes that lie beside their objects."""
    again = draw_place(np.random.default_rng(3), size=512)
    assert np.array_equal(place.image_bgr, again.image_bgr)
    assert np.array_equal(place.boxes_px, again.boxes_px)
    assert len(place.boxes_px) > 5
    assert (place.boxes_px >= 0).all()
    assert (place.boxes_px <= 512).all()
    assert ((place.visible >= 0) & (place.visible <= 1)).all()


def test_a_place_seen_aslant_has_small_cars():
    """Cars of 30 pixels that a far camera sees aslant were hardly in any picture, and hardly found."""
    boxes = [draw_place(np.random.default_rng(seed), size=512, aslant=True) for seed in range(3)]
    cars = np.concatenate([picture.boxes_px[picture.class_ids == 0] for picture in boxes])
    sides = cars[:, 2:] - cars[:, :2]
    assert len(cars) > 10
    assert 15 < np.median(sides[:, 0]) < 120


@pytest.mark.parametrize(
    ("name", "most"), list(zip(CLASSES, (5.3, 6.9, 12.1, 13.1, 2.4, 0.7, 12.3), strict=True))
)
def test_every_class_can_be_made_and_has_its_size(name, most):
    """A class would be missing from training, or as large as another one."""
    lengths = []
    for seed in range(12):
        solid = make_solid(name, np.random.default_rng(seed))
        assert solid.class_name == name
        lengths.append(np.ptp(solid.foot_m[:, 0]))
    assert max(lengths) <= most
    assert len(set(lengths)) > 1 or name == "pedestrian"


def test_a_view_keeps_boxes_on_their_objects(tmp_path):
    """Labels would drift from the pixels when a picture is cut, scaled, mirrored and turned."""
    image = np.full((300, 400, 3), 30, np.uint8)
    image[100:160, 200:240] = 250
    boxes = np.array([[200, 100, 240, 160]], np.float32)
    picture = Picture(image, boxes, np.array([3], np.int32), np.ones(1, np.float32))
    pool = [save(tmp_path, picture)]
    source = ViewSource(pool, seed=5, settings=ViewSettings(side=128))
    checked = 0
    for _ in range(40):
        view = source.next()
        assert view.image_bgr.shape == (128, 128, 3)
        for (x0, y0, x1, y1), kind in zip(view.boxes_px.round().astype(int), view.class_ids, strict=True):
            if kind != 3 or min(x1 - x0, y1 - y0) < 12 or min(x0, y0) < 6 or max(x1, y1) > 122:
                continue
            inner = view.image_bgr[y0 + 3 : y1 - 3, x0 + 3 : x1 - 3].mean()
            frame = view.image_bgr[max(y0 - 8, 0) : y1 + 8, max(x0 - 8, 0) : x1 + 8].astype(float)
            area = (x1 - x0 - 6) * (y1 - y0 - 6)
            ring = (frame.sum() / 3 - inner * area) / (frame.size / 3 - area)
            assert inner > ring + 15
            checked += 1
    assert checked > 5


def test_roofs_with_codes_are_a_kind_of_their_own(tmp_path, monkeypatch):
    """The demo's vans, which carry codes, would be cars to a detector that only saw bare roofs."""
    shown = []

    def shot(seed, **how):
        shown.append(shoot(seed, **how))
        return shown[-1]

    monkeypatch.setattr("hvt_train.pictures.pool.shoot", shot)
    monkeypatch.setattr("hvt_train.pictures.pool.ProcessPoolExecutor", lambda _: ThreadPoolExecutor(1))
    files = fill_pool(tmp_path, PoolPlan(scenes=0, codes=1, places=0, aslant=0))
    assert [file.name for file in files] == [f"codes-{how}-00000-0.npz" for how in ("base", "demo", "thin")]
    assert shown[0].codes(1.0)
    assert len(ViewSource(files, seed=1, settings=ViewSettings(side=64)).next().image_bgr) == 64


def test_what_is_hidden_is_neither_object_nor_background(tmp_path, place):
    """The detector would be told that a car under a tree is ground, or must be found where nothing shows."""
    hidden = Picture(place.image_bgr, place.boxes_px, place.class_ids, np.zeros_like(place.visible))
    view = ViewSource([save(tmp_path, hidden)], seed=1, settings=ViewSettings(side=128)).next()
    assert (view.class_ids == -1).all()


def test_degrading_keeps_the_size_and_changes_the_picture():
    """Training would see only clean pictures, which the base never shows."""
    image = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    changed = [degrade(image, np.random.default_rng(seed), strength=1.0, compress=0.6) for seed in range(8)]
    assert all(one.shape == image.shape and one.dtype == np.uint8 for one in changed)
    assert sum(not np.array_equal(one, image) for one in changed) >= 7


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("curve torn --out a.svg", """torn, line 2 is '{"step":'; accepted is {"step": 50, …}"""),
        ("curve stray --out a.svg", "stray, line 1 is '3'; accepted is"),
        ("curve empty --out a.svg", "empty has no loss"),
        ("curve good --out good", "--out good is good itself, which is read"),
        ("curve good --out good/a.svg", "--out good/a.svg cannot be made (File exists)"),
        ("eval --real . --reference good", ". is no file"),
        ("eval --real good --reference good", "good is not a video that can be read"),
        ("eval --drawn --seeds 0", "--seeds is 0, must be at least 1"),
        ("eval --real good --reference good --every 0", "--every is 0, must be at least 1"),
    ],
)
def test_what_cannot_be_drawn_or_measured_is_said(tmp_path, monkeypatch, capsys, words, said):
    """They ended in tracebacks, in nan, or in a picture of nothing."""
    monkeypatch.chdir(tmp_path)
    good = '{"step": 1, "loss": 2}\n'
    for name, text in (("torn", good + '{"step":'), ("stray", "3"), ("empty", ""), ("good", good)):
        (tmp_path / name).write_text(text)
    assert main(words.split()) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "a.svg").exists()
    assert (tmp_path / "good").read_text() == good


class Fixed:
    """Say the same of every picture."""

    class_names = CLASSES

    def __init__(self, boxes, scores, kinds):
        self.detect = lambda _: detections(boxes, scores, kinds)


@pytest.mark.parametrize(
    ("right", "objects", "precision"),
    [((1, 1, 1), 3, 1.0), ((1, 0, 1), 2, 0.5 + 0.5 * 2 / 3), ((0, 0, 0), 2, 0.0), ((), 2, 0.0)],
)
def test_average_precision_of_known_lists(right, objects, precision):
    """Every quality figure in the documentation would be wrong."""
    scores = np.array([0.9, 0.8, 0.7], np.float32)[: len(right)]
    assert average_precision(scores, np.array(right, bool), objects) == pytest.approx(precision)


def test_doubles_and_misses_cost_and_hidden_objects_do_not():
    """A detector that answers twice, or is punished for what nobody can see, would look other than it is."""
    boxes = np.array([[0, 0, 20, 20], [40, 0, 60, 20], [80, 0, 100, 20]], np.float32)
    image, visible = np.zeros((32, 128, 3), np.uint8), np.array([1, 1, 0.1], np.float32)
    picture = Picture(image, boxes, np.zeros(3, np.int32), visible)
    both = Fixed(boxes, [0.9, 0.8, 0.7], [0, 0, 0])
    assert evaluate_drawn(both, [picture]).by_class == {"car": pytest.approx(1.0)}
    doubled = Fixed([boxes[0], boxes[0], boxes[1]], [0.9, 0.8, 0.7], [0, 0, 0])
    assert evaluate_drawn(doubled, [picture]).mean == pytest.approx(0.5 + 0.5 * 2 / 3)
    assert evaluate_drawn(Fixed(boxes[:1], [0.9], [0]), [picture]).mean == pytest.approx(0.5)
    assert evaluate_drawn(Fixed(boxes[:2], [0.9, 0.8], [1, 1]), [picture]).mean == 0.0


def test_real_agreement_counts_any_vehicle_and_no_person():
    """The figure on real pixels would depend on whether a pickup is called car or truck."""
    boxes = np.array([[0, 0, 20, 20], [40, 0, 60, 20], [80, 0, 100, 20]], np.float32)
    found = Fixed(boxes, [0.9, 0.8, 0.7], [2, 1, 5])
    result = evaluate_real(found, [np.zeros((8, 8, 3), np.uint8)], [boxes[[0, 2]]])
    assert (result.recall, result.precision, result.objects) == (0.5, 0.5, 2)


@pytest.fixture
def torch():
    torch = pytest.importorskip("torch")
    torch.set_num_threads(1)
    torch.manual_seed(0)
    return torch


@pytest.fixture
def batch(torch, tmp_path, place):
    from hvt_train.learning.train_detector import batch_of

    source = ViewSource([save(tmp_path, place)], seed=2, settings=ViewSettings(side=128))
    return batch_of([source.next() for _ in range(8)])


def test_training_lowers_the_loss(torch, batch):
    """The recipe would run for an hour and learn nothing."""
    from hvt_train.learning.detector import DetectorNet
    from hvt_train.learning.train_detector import loss_of

    net = DetectorNet(len(CLASSES)).train()
    optimizer = torch.optim.AdamW(net.parameters(), lr=2e-3)
    losses = []
    for _ in range(40):
        loss, _ = loss_of(net, batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.detach().item())
    assert losses[-1] < 0.8 * losses[0]


def test_perfect_answers_cost_next_to_nothing(torch):
    """The loss would pull right answers away from where they belong."""
    from hvt_train.learning.train_detector import Targets, detector_loss

    maps = [torch.full((1, 12, side, side), -12.0) for side in (16, 8, 4)]
    for level in maps:
        level[:, :2], level[:, 2:4] = 0.0, -5.0
    target = torch.tensor([[32.0, 32.0, 56.0, 56.0]])  # centre 44, 44: cell 5, 5 of stride 8
    for column, shift in ((5, 0.5), (4, 1.5)):  # two cells are asked at least
        answer = [shift, 0.5, np.log(3), np.log(3), 12, 12, -12, -12, -12, -12, -12, -12]
        maps[0][0, :, 5, column] = torch.tensor(answer)
    right = Targets(torch.tensor([0]), target, torch.tensor([0]))
    loss, parts = detector_loss(maps, right)
    assert parts["cells"] == 2
    assert loss.item() < 0.02
    ignored, _ = detector_loss(maps, Targets(torch.tensor([0]), target, torch.tensor([-1])))
    assert ignored.item() < 0.02
    nothing = Targets(torch.tensor([]).long(), torch.zeros(0, 4), torch.tensor([]).long())
    missed, _ = detector_loss(maps, nothing)
    assert missed.item() > 5


def test_the_onnx_file_answers_as_the_network_does(torch, tmp_path):
    """What was measured in training would not be what flies."""
    pytest.importorskip("onnx")
    from hvt_common.inference.detect import open_detector
    from hvt_common.inference.runtimes.model import open_model
    from hvt_train.learning.detector import DetectorNet, ExportedDetector
    from hvt_train.learning.train_detector import export_detector

    net = DetectorNet(len(CLASSES)).eval()
    for level in net.modules():
        if isinstance(level, torch.nn.BatchNorm2d):
            level.running_mean.normal_(0, 0.1)
            level.running_var.uniform_(0.5, 1.5)
    path = tmp_path / "net.onnx"
    export_detector(net, path, properties={"names": str(dict(enumerate(CLASSES)))})
    images = torch.randint(0, 255, (1, 3, 96, 160)).float()
    with torch.no_grad():
        expected = ExportedDetector(net)(images).numpy()
    answer = open_model(path).run(images.numpy())[0]
    assert answer.shape == expected.shape == (1, 12 * 20 + 6 * 10 + 3 * 5, 12)
    assert np.abs(answer - expected).max() < 0.02  # weights are stored as float16
    assert open_detector(str(path)).class_names == CLASSES


def test_the_classifier_file_answers_as_the_network_does(torch, tmp_path):
    """Crops would be prepared otherwise in the air than in training."""
    pytest.importorskip("onnx")
    from hvt_common.inference.classify import open_classifier
    from hvt_train.learning.classifier import MEAN, SCALE, ClassifierNet, export_classifier

    net = ClassifierNet(len(CLASSES)).eval()
    path = tmp_path / "cls.onnx"
    export_classifier(net, path, properties={"names": str(dict(enumerate(CLASSES)))})
    crops = np.random.default_rng(0).integers(0, 255, (3, 96, 96, 3), np.uint8)
    values = (torch.from_numpy(crops).permute(0, 3, 1, 2).float() - MEAN) * SCALE
    with torch.no_grad():
        expected = net(values).softmax(1).numpy()
    posteriors = open_classifier(str(path)).classify(list(crops))
    assert np.abs(np.stack([p.probabilities for p in posteriors]) - expected).max() < 0.01
