"""The drawn demo scene and its ground truth."""

import hashlib

import cv2
import numpy as np
import pytest

from hvt_common.values import View
from hvt_scene import Appearance, Scene
from hvt_scene.drawing.vehicles import CLASS_NAMES, draw_vehicle
from hvt_scene.view import turns

CLASSES = ("car", "van", "truck", "bus", "motor", "pedestrian", "other")


@pytest.fixture(scope="module")
def scene():
    return Scene(0)


@pytest.fixture(scope="module")
def bare():
    """Draw without shadows, so that a body alone makes the difference between two pictures; small, to be quick."""
    return Scene(0, size=(960, 540), appearance=Appearance(shadow_strength=0.0))


@pytest.fixture(scope="module")
def tilted():
    """Look aslant at a scene that is turned."""
    return Scene(
        4, size=(960, 540), appearance=Appearance(shadow_strength=0.0, tilt_deg=25.0, roll_deg=(40.0, 60.0))
    )


def digest(image):
    return hashlib.sha256(image.tobytes()).hexdigest()


def test_the_same_seed_draws_the_same_bytes_and_another_does_not():
    """Two runs of the demo would not be comparable, nor could a training set be made again."""
    first, second, other = (Scene(seed, size=(480, 270)) for seed in (5, 5, 6))
    for t_s in (7.123, 20.0):
        assert digest(first.image(t_s)) == digest(second.image(t_s))
        assert np.array_equal(first.truth(t_s).boxes_source_px, second.truth(t_s).boxes_source_px)
    assert digest(first.image(7.123)) != digest(other.image(7.123))


def test_order_and_rate_of_asking_do_not_matter(bare):
    """A demo at 15 fps would show another world than one at 30 fps."""
    late_first = [digest(bare.image(t_s)) for t_s in (12.0, 3.0)]
    early_first = [digest(bare.image(t_s)) for t_s in (3.0, 12.0)]
    assert late_first == early_first[::-1]


def test_shape_time_and_names(scene):
    """The edge could not encode what it was promised."""
    image = scene.image(1.0)
    assert (image.shape, image.dtype, scene.duration_s) == ((1080, 1920, 3), np.uint8, 20.0)
    assert scene.class_names == CLASSES == CLASS_NAMES
    for wrong in (-0.01, 20.01):
        with pytest.raises(ValueError, match="outside"):
            scene.image(wrong)


def test_every_class_appears_and_the_number_of_objects_is_plausible(scene):
    """A detector trained or measured on the scene would never meet some class."""
    seen = np.zeros(len(CLASSES), int)
    for t_s in range(0, 20, 2):
        truth = scene.truth(float(t_s))
        assert 40 <= len(truth) <= 220
        seen += np.bincount(truth.class_ids, minlength=len(CLASSES))
        boxes = truth.boxes_source_px
        assert boxes.dtype == np.float32
        assert (boxes[:, :2] < boxes[:, 2:]).all()
        assert (boxes >= 0).all()
        assert (boxes <= (1920, 1080, 1920, 1080)).all()
        assert ((truth.visible >= 0) & (truth.visible <= 1)).all()
    assert (seen > 0).all()
    assert seen.argmax() == CLASSES.index("car")


def test_ids_are_stable_and_objects_move_smoothly_enter_and_leave(scene):
    """Identity metrics against the scene would count swaps that nobody made."""
    classes: dict[int, int] = {}
    before = scene.truth(0.0)
    start = set(before.ids.tolist())
    for step in range(1, 301):
        now = scene.truth(step / 15)
        assert len(set(now.ids.tolist())) == len(now)
        for number, kind in zip(now.ids.tolist(), now.class_ids.tolist(), strict=True):
            assert classes.setdefault(number, kind) == kind
        _, old, new = np.intersect1d(before.ids, now.ids, return_indices=True)
        inner = _inside(before.boxes_source_px[old]) & _inside(now.boxes_source_px[new])
        assert inner.sum() > 20
        shift = np.abs(_centres(now.boxes_source_px[new]) - _centres(before.boxes_source_px[old]))[inner]
        # 60 km/h at 15 fps is 1.1 m a frame, under 20 px, and the camera pans a few.
        assert shift.max() < 30
        before = now
    end = set(before.ids.tolist())
    assert len(start - end) > 10
    assert len(end - start) > 10


def test_some_drive_and_some_are_hidden_by_trees(scene):
    """The scene would hold nothing that a tracker can fail at."""
    middle = [scene.truth(t_s) for t_s in (5.0, 10.0, 15.0)]
    hidden = [
        v for truth in middle for v, b in zip(truth.visible, truth.boxes_source_px, strict=True) if _inside(b)
    ]
    assert min(hidden) < 0.6
    assert np.median(hidden) > 0.97


@pytest.mark.parametrize("name", ["bare", "tilted"])
def test_boxes_fit_the_pixels(name, request):
    """Every measured precision and every training label would be off."""
    scene = request.getfixturevalue(name)
    t_s, checked = 9.0, dict.fromkeys(CLASSES, 0)
    whole, truth = scene.image(t_s).astype(int), scene.truth(t_s)
    for number, box, kind, share in zip(
        truth.ids.tolist(), truth.boxes_source_px, truth.class_ids, truth.visible, strict=True
    ):
        if share < 1 or not _inside(box, size=(960, 540), margin=3) or checked[CLASSES[kind]] >= 6:
            continue
        rest = scene.image(t_s, without=[number]).astype(int)
        change = np.abs(whole - rest).max(2)
        rows, columns = np.nonzero(change)
        # Nothing outside but the soft edge; on each side the body reaches the box.
        assert columns.min() >= box[0] - 2
        assert rows.min() >= box[1] - 2
        assert columns.max() + 1 <= box[2] + 2
        assert rows.max() + 1 <= box[3] + 2
        rows, columns = np.nonzero(change > 3)
        found = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
        assert np.abs(found - box).max() <= 2, (CLASSES[kind], found, box)
        checked[CLASSES[kind]] += 1
    assert sum(checked.values()) >= 15
    assert sum(count > 0 for count in checked.values()) >= 4


def test_visibility_is_the_share_of_pixels_that_show(bare):
    """An object under a tree would count as a miss of the detector."""
    pairs = []
    for t_s in np.arange(0.5, 20, 0.75):
        truth = bare.truth(float(t_s))
        partly = (
            (truth.visible > 0.05) & (truth.visible < 0.95) & (truth.class_ids != CLASSES.index("pedestrian"))
        )
        partly &= _inside(truth.boxes_source_px, size=(960, 540))
        for row in np.nonzero(partly)[0][:3]:
            box = truth.boxes_source_px[row]
            rest = bare.image(t_s, without=[int(truth.ids[row])])
            change = np.abs(bare.image(t_s).astype(int) - rest)
            area = (box[2] - box[0]) * (box[3] - box[1])
            pairs.append(((change.max(2) > 0).sum(), truth.visible[row], area))
    assert len(pairs) >= 5
    for pixels, share, area in pairs:
        # The box is at most about twice the body's area when it is turned, and never smaller.
        assert 0.3 * share - 0.1 < pixels / area < 1.2 * share + 0.15


def test_traffic_does_not_drive_through_itself(scene):
    """A person would see at once that the demo is broken."""
    cast = scene.cast
    driving = np.nonzero(cast.class_ids != CLASSES.index("pedestrian"))[0]
    for t_s in range(0, 20, 2):
        places = cast.places(float(t_s))
        hulls = (cast.outlines_m @ turns(places).transpose(0, 2, 1) + places[:, None, :2]).astype(np.float32)
        within = driving[((places[driving, :2] > 0) & (places[driving, :2] < (270, 136))).all(1)]
        gaps = np.linalg.norm(places[within, None, :2] - places[within, :2], axis=2)
        close = np.triu(gaps < cast.reach_m[within, None] + cast.reach_m[within], 1)
        assert close.sum() > 50  # stalls are close to one another
        itself, _ = cv2.intersectConvexConvex(cv2.convexHull(hulls[0]), cv2.convexHull(hulls[0]))
        assert itself > 0.5
        for i, j in within[np.argwhere(close)]:
            overlap, _ = cv2.intersectConvexConvex(cv2.convexHull(hulls[i]), cv2.convexHull(hulls[j]))
            assert overlap < 0.1, (t_s, cast.class_ids[[i, j]], places[[i, j]])


def test_a_class_is_told_by_texture_that_the_base_size_loses(scene):
    """Stills would have nothing to add to the base stream."""
    image = scene.image(10.0)
    view = View.fitted((1920, 1080), (640, 360), fit="letterbox")
    small = cv2.resize(image, view.base_size, interpolation=cv2.INTER_AREA)
    back = cv2.resize(small, (1920, 1080), interpolation=cv2.INTER_CUBIC)
    loss = np.abs(back.astype(int) - image)
    truth = scene.truth(10.0)
    large = [
        b.astype(int)
        for b, v in zip(truth.boxes_source_px, truth.visible, strict=True)
        if v == 1 and b[2] - b[0] > 60
    ]
    assert np.mean([loss[b[1] : b[3], b[0] : b[2]].mean() for b in large]) > 1.5 * loss.mean()


@pytest.mark.parametrize(
    ("kind", "least", "most"),
    list(zip(CLASSES, (3.7, 0, 7, 10, 0, 0, 0), (5.1, 6, 99, 99, 2.4, 1.0, 99), strict=True)),
)
def test_sprites_vary_and_keep_the_size_of_their_class(kind, least, most):
    """All cars would look alike, or a van would be as long as a bus."""
    sprites = [draw_vehicle(kind, np.random.Generator(np.random.PCG64(seed))) for seed in range(12)]
    assert len({digest(sprite.level(0.02)[0]) for sprite in sprites}) == 12
    lengths = [float(np.ptp(sprite.outline_m[:, 0])) for sprite in sprites]
    assert max(lengths) < most
    assert (max if kind == "truck" else min)(lengths) > least


def test_random_looks_differ_strongly():
    """A detector trained on the scene would learn its asphalt by heart."""
    looks = [Appearance.random(seed) for seed in range(3)]
    assert looks == [Appearance.random(seed) for seed in range(3)]
    drawn = (Scene(seed, size=(480, 270), appearance=one) for seed, one in enumerate(looks))
    assert (np.ptp([one.image(5.0).mean((0, 1)) for one in drawn], axis=0) > 20).all()


def test_truth_is_written_as_motchallenge_lines_in_base_pixels(scene, tmp_path):
    """Public evaluation tools could not read it, or would score every box against the wrong pixels."""
    view = View.fitted(scene.size, (1280, 720), fit="letterbox")
    file = tmp_path / "gt.txt"
    scene.write_truth(file, fps=2, view=view)
    table = np.loadtxt(file, delimiter=",")
    assert sorted(set(table[:, 0])) == list(range(1, 41))
    assert set(table[:, 7]) <= set(range(1, 8))
    rows = table[table[:, 0] == 21]
    truth = scene.truth(10.0)
    assert rows[:, 1].tolist() == truth.ids.tolist()
    expected = view.to_base(truth.boxes_source_px)
    assert np.allclose(rows[:, 2:4], expected[:, :2] + 1, atol=0.011)  # the first pixel is 1
    assert np.allclose(rows[:, 4:6], expected[:, 2:] - expected[:, :2], atol=0.011)


def _inside(boxes, *, size=(1920, 1080), margin=2):
    low = (boxes[..., :2] > margin).all(-1)
    return low & (boxes[..., 2] < size[0] - margin) & (boxes[..., 3] < size[1] - margin)


def _centres(boxes):
    return (boxes[:, :2] + boxes[:, 2:]) / 2
