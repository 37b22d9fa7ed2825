"""ByteTrack: fidelity to the authors' program, life of a track, and the filter and assignment beneath it."""

import json
import tracemalloc
from dataclasses import asdict
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from hvt_common.tracking import kalman
from hvt_common.tracking.association import assign, larger, overlaps
from hvt_common.tracking.bytetrack import ByteTracker
from hvt_common.tracking.motion import box_flow
from hvt_common.tracking.settings import TrackerSettings
from hvt_common.values import Detections, iou
from hvt_study.metrics.tracking import compare_tracks
from rigs.examples import detections

seeds = st.integers(0, 2**32 - 1)


def seen(*boxes, confidence=0.9, class_id=0):
    return detections(boxes, confidence, class_id)


def scene(seed, *, frames=12, count=8):
    """Moving boxes with jitter, gaps and every level of confidence; coordinates are multiples of 1/16 px."""
    rng = np.random.default_rng(seed)
    centre, velocity = rng.uniform(50, 400, (count, 2)), rng.normal(0, 4, (count, 2))
    size = rng.uniform(15, 60, (count, 2))
    result = []
    for _ in range(frames):
        centre = centre + velocity
        boxes = np.concatenate((centre - size / 2, centre + size / 2), axis=1)
        boxes = np.round((boxes + rng.normal(0, 1.5, boxes.shape)) * 16) / 16
        kept = rng.random(count) > 0.15
        confidences = np.clip(rng.beta(4, 2, count), 0, 1)
        result.append(detections(boxes[kept], confidences[kept], rng.integers(0, 3, int(kept.sum()))))
    return result


def run(tracker, detections, *, every=1):
    """All frames through a tracker, with detection on every n-th."""
    return [
        tracker.update(each, frame_index=k) if k % every == 0 else tracker.predict(frame_index=k)
        for k, each in enumerate(detections)
    ]


# --- fidelity


def palace(data):
    """Detections of each frame of the street scene, and rows of the authors' tracks with x2, y2 for w, h."""
    results = json.loads((data / "tracking/palace/detections.json").read_text())["results"]
    rows = np.array(
        [[float(r[k]) for k in ("frame_id", "x", "y", "width", "height", "prob")] for r in results]
    )
    rows[:, 3:5] += rows[:, 1:3]
    detections = []
    for frame in range(int(rows[:, 0].max()) + 1):
        here = rows[rows[:, 0] == frame]
        confidences = here[:, 5].astype(np.float32)
        detections.append(
            Detections(here[:, 1:5].astype(np.float32), confidences, np.zeros(len(here), np.int32))
        )
    reference = np.loadtxt(data / "tracking/palace/bytetrack_tracks.txt", delimiter=",")
    reference[:, 4:6] += reference[:, 2:4]
    return detections, {k: reference[reference[:, 0] == k] for k in range(len(detections))}


@pytest.mark.realdata
def test_reproduces_the_authors_program_box_by_box(data):
    """Results published with ByteTrack would not hold for HVT: another id, box or score somewhere."""
    detections, reference = palace(data)
    ours = run(ByteTracker(fps=30), detections)
    assert len({int(i) for tracks in ours for i in tracks.ids}) == 45
    for tracks in ours:
        expected = reference[tracks.frame_index]
        expected = expected[np.argsort(expected[:, 1])]
        assert tracks.ids.tolist() == expected[:, 1].astype(int).tolist()
        np.testing.assert_allclose(tracks.boxes_xyxy_px, expected[:, 2:6], atol=1e-3)
        np.testing.assert_allclose(tracks.confidences, expected[:, 6], atol=1e-4)


@pytest.mark.realdata
def test_every_fifth_frame_still_follows_the_scene(data):
    """Detection every fifth frame (the default) would lose or mix up objects between the detections."""
    detections, reference = palace(data)
    truth = [(rows[:, 1].astype(int), rows[:, 2:6]) for rows in reference.values()]
    ours = [
        (one.ids, one.boxes_xyxy_px.astype(float)) for one in run(ByteTracker(fps=30), detections, every=5)
    ]
    result = compare_tracks(list(zip(truth, ours, strict=True)), least_iou=0.5)
    assert result.idf1 > 0.78
    assert result.mota > 0.84


def dense_filter(measurements):
    """One track through the textbook 8x8 filter: initiate, then predict and correct for each measurement."""
    transition, observe = np.eye(8) + np.eye(8, k=4), np.eye(4, 8)

    def noise(h, p, v):
        return np.diag(np.square([p * h, p * h, 1e-2, p * h, v * h, v * h, 1e-5, v * h]))

    mean = np.r_[measurements[0], np.zeros(4)]
    covariance = noise(mean[3], 2 / 20, 10 / 160)
    for measured in measurements[1:]:
        process = noise(mean[3], 1 / 20, 1 / 160)
        mean, covariance = transition @ mean, transition @ covariance @ transition.T + process
        h = mean[3]
        expected = observe @ covariance @ observe.T + np.diag(np.square([h / 20, h / 20, 1e-1, h / 20]))
        gain = covariance @ observe.T @ np.linalg.inv(expected)
        mean = mean + gain @ (measured - observe @ mean)
        covariance = covariance - gain @ expected @ gain.T
    return mean, covariance


def test_the_split_filter_equals_the_dense_one():
    """Boxes would drift from what ByteTrack computes: the four 2x2 blocks must hold the whole covariance."""
    rng = np.random.default_rng(1)
    steps = np.cumsum(rng.normal(0, [4, 4, 0.01, 1], (20, 5, 4)), axis=0)
    steps += [200, 100, 0.5, 80]
    states = kalman.initiate(steps[0].T)
    for measured in steps[1:]:
        kalman.predict(states)
        kalman.correct(states, measured.T)
    for k in range(5):
        mean, covariance = dense_filter(steps[:, k])
        state = states[..., k]
        np.testing.assert_allclose(state[:2].ravel(), mean, rtol=1e-9, atol=1e-9)
        blocks = np.diag([*state[kalman.VAR_P], *state[kalman.VAR_V]])
        blocks += np.diag(state[kalman.COV_PV], 4) + np.diag(state[kalman.COV_PV], -4)
        np.testing.assert_allclose(blocks, covariance, rtol=1e-9, atol=1e-12)


@given(seed=seeds, rows=st.integers(0, 7), columns=st.integers(0, 7), limit=st.floats(0.05, 1))
def test_assignment_has_the_optimum_of_lap_with_a_cost_limit(seed, rows, columns, limit):
    """Where objects are close, tracks would take other detections than in ByteTrack."""
    cost = np.random.default_rng(seed).random((rows, columns))
    extended = np.full((rows + columns, rows + columns), limit / 2)  # what lap.lapjv(extend_cost=True) solves
    extended[:rows, :columns] = cost
    extended[rows:, columns:] = 0
    i, j = linear_sum_assignment(extended)
    real = (i < rows) & (j < columns)
    ours = assign(cost, limit=limit)
    assert sorted(zip(*map(np.ndarray.tolist, ours), strict=True)) == sorted(
        zip(i[real].tolist(), j[real].tolist(), strict=True)
    )


def test_overlap_counts_whole_pixels():
    """Small objects would be matched more strictly than in ByteTrack."""
    a = np.array([[0.0, 0.0, 9.0, 9.0]]).T
    b = np.array([[0.0, 0.0, 9.0, 9.0], [5.0, 0.0, 14.0, 9.0], [20.0, 0.0, 29.0, 9.0]]).T
    shared = overlaps(a, b)
    assert (shared.rows.tolist(), shared.columns.tolist()) == ([0, 0], [0, 1]), "nothing of the third"
    np.testing.assert_allclose(shared.iou, [1.0, 50 / 150])
    nothing = overlaps(a, b[:, 2:])
    assert [len(column) for column in larger(nothing, nothing)] == [0, 0, 0], "a session ended with it"
    for pair in ((shared, nothing), (nothing, shared)):
        np.testing.assert_array_equal(larger(*pair).iou, shared.iou)


# --- properties


@given(seed=seeds, every=st.sampled_from([1, 3]))
@settings(max_examples=30)
def test_order_of_detections_does_not_matter(seed, every):
    """Edge and ground would number the same objects differently when their detectors order boxes differently."""
    rng = np.random.default_rng(seed)
    detections = scene(seed)
    detections[4].confidences[:] = 0.8  # ties too
    shuffled = []
    for each in detections:
        order = rng.permutation(len(each))
        shuffled.append(Detections(each.boxes_xyxy_px[order], each.confidences[order], each.class_ids[order]))
    for a, b in zip(
        run(ByteTracker(fps=15), detections, every=every),
        run(ByteTracker(fps=15), shuffled, every=every),
        strict=True,
    ):
        assert a.ids.tolist() == b.ids.tolist()
        np.testing.assert_array_equal(a.boxes_xyxy_px, b.boxes_xyxy_px)
        np.testing.assert_array_equal(a.class_ids, b.class_ids)


@given(seed=seeds, dx=st.integers(-500, 500), dy=st.integers(-500, 500))
@settings(max_examples=30)
def test_tracks_move_with_the_picture(seed, dx, dy):
    """Objects would be tracked differently in one corner of the frame than in another."""
    detections = scene(seed)
    shift = np.array([dx, dy, dx, dy], np.float32)
    shifted = [Detections(d.boxes_xyxy_px + shift, d.confidences, d.class_ids) for d in detections]
    for a, b in zip(run(ByteTracker(fps=15), detections), run(ByteTracker(fps=15), shifted), strict=True):
        assert a.ids.tolist() == b.ids.tolist()
        np.testing.assert_allclose(a.boxes_xyxy_px + shift, b.boxes_xyxy_px, atol=1e-3)


@given(st.lists(st.tuples(st.booleans(), st.integers(1, 90), st.booleans()), max_size=20))
@settings(max_examples=60)
def test_any_sequence_of_calls_is_survived(calls):
    """An empty street, a gap in the stream or a pause of the detector would stop the edge or the ground."""
    tracker, frame = ByteTracker(fps=15), 0
    for searched, step, empty in calls:
        frame += step
        detections = Detections.none() if empty else seen((10, 10, 40, 40), (100, 50, 130, 90))
        tracks = (
            tracker.update(detections, frame_index=frame) if searched else tracker.predict(frame_index=frame)
        )
        assert tracks.frame_index == frame
        assert np.isfinite(tracks.boxes_xyxy_px).all()
        assert (np.diff(tracks.ids) > 0).all()


# --- life of a track


def test_a_new_object_is_listed_when_found_twice():
    """Each false alarm would be a track, or a real object never one; the first frame would be empty."""
    tracker, box = ByteTracker(fps=30), (100, 100, 140, 160)
    tracker.update(Detections.none(), frame_index=0)
    assert len(tracker.update(seen(box), frame_index=1)) == 0
    found = tracker.update(seen(box), frame_index=2)
    assert (found.ids.tolist(), found.started.tolist()) == ([1], [True])
    assert (found.born_frames.tolist(), found.seen_frames.tolist()) == ([1], [2])
    assert tracker.update(seen(box), frame_index=3).started.tolist() == [False]
    first = ByteTracker(fps=30).update(seen(box), frame_index=0)
    assert (first.ids.tolist(), first.started.tolist()) == ([1], [True])
    assert len(ByteTracker(fps=30).update(seen(box, confidence=0.55), frame_index=0)) == 0


def test_a_weak_detection_carries_a_track_on():
    """Partly hidden objects would be lost: the very idea of ByteTrack."""
    tracker = ByteTracker(fps=30)
    tracker.update(seen((0, 0, 40, 40)), frame_index=0)
    tracks = tracker.update(seen((0, 0, 40, 40), confidence=0.2), frame_index=1)
    assert tracks.ids.tolist() == [1]
    assert tracks.confidences[0] == pytest.approx(0.2)
    assert len(tracker.update(seen((0, 0, 40, 40), confidence=0.09), frame_index=2)) == 0


def test_predicted_frames_carry_tracks_on_and_lose_none():
    """Between detections the map would be empty, or stand still."""
    moving = [seen((100 + 4 * k, 100, 140 + 4 * k, 160)) for k in range(30)]
    listed = run(ByteTracker(fps=15), moving, every=5)
    assert {tuple(tracks.ids.tolist()) for tracks in listed} == {(1,)}
    assert [tracks.seen_frames[0] for tracks in listed] == [k // 5 * 5 for k in range(30)]
    assert [k for k, tracks in enumerate(listed) if tracks.started.any()] == [0]
    np.testing.assert_allclose(listed[29].boxes_xyxy_px, moving[29].boxes_xyxy_px, atol=2)


@pytest.mark.parametrize(("fps", "every"), [(15, 5), (3, 1)])
def test_a_small_fast_object_is_confirmed_between_rare_detections(fps, every):
    """A car that leaves its own box in a third of a second never became a track, of a camera of 3 fps above all."""
    cars = [(100 + 4.5 * k, 100, 118 + 4.5 * k, 112) for k in range(0, 26, 5)]
    found = {}
    for growth in (0.0, 3.0):
        tracker = ByteTracker(TrackerSettings(search_growth_per_s=growth), fps=fps)
        tracker.update(Detections.none(), frame_index=0)
        ids = [
            tracker.update(seen(car), frame_index=every * k).ids.tolist()
            for k, car in enumerate(cars, start=1)
        ]
        found[growth] = ids
    assert found[0.0] == [[], [], [], [], [], []]
    assert found[3.0] == [[], [1], [1], [1], [1], [1]]


def test_what_drives_into_the_picture_keeps_its_width():
    """Its bonnet is wide and flat; a box of that shape around the whole car would be twice as wide as the car."""
    tracker, boxes = ByteTracker(fps=15), []
    for frame in range(0, 31, 5):
        bottom = min(430, 260 + 8 * frame)  # it comes from above, and what of it is in the picture grows
        tracks = tracker.update(seen((300, 230, 400, bottom)), frame_index=frame)
        boxes.append(tracks.boxes_xyxy_px[0])
    widths = [x2 - x1 for x1, _, x2, _ in boxes]
    assert max(widths) < 160, "100 is right; as with a detection a frame it was 400, and the track was lost"
    assert widths[-1] == pytest.approx(100, abs=10)


@pytest.mark.parametrize("every", [1, 5])
@pytest.mark.parametrize(("hidden_frames", "same"), [(20, True), (25, True), (45, False)])
def test_lost_tracks_are_remembered_in_frames_not_in_updates(every, hidden_frames, same):
    """A car behind a bridge would come out as another, or another car as the one that went in."""
    again = 10 + hidden_frames
    visible = [k <= 10 or k >= again for k in range(again + 11)]
    shown = [seen((100, 100, 140, 160)) if there else Detections.none() for there in visible]
    listed = run(ByteTracker(fps=30), shown, every=every)
    assert all(
        len(tracks) == 0 or there for tracks, there in list(zip(listed, visible, strict=True))[::every]
    )
    assert listed[again].started.tolist() == ([True] if same else [])
    assert listed[-1].ids.tolist() == ([1] if same else [2])


@pytest.mark.parametrize("every_s", [1.0, 1.5, 5.0])
@pytest.mark.parametrize("predicted", [0, 2, None], ids=["none", "some", "all"])
@pytest.mark.parametrize("lengths_per_s", [0.0, 0.3])
def test_a_slow_machine_lists_what_stands_or_moves_slowly(every_s, predicted, lengths_per_s):
    """With a detection in some seconds, a board would burn a core for nothing, and show nothing."""
    tracker, fps = ByteTracker(TrackerSettings.starting_at(0.25, camera_motion="off"), fps=15), 15
    every = round(every_s * fps)
    for k in range(12 * every):
        moved = k / fps * lengths_per_s * 60
        boxes = [(100 + moved, 100, 160 + moved, 140), (900 - moved, 300, 960 - moved, 340)]
        if k % every == 0:
            tracks = tracker.update(seen(*boxes, confidence=0.8), frame_index=k)
        elif predicted is None or k % every <= predicted:
            tracks = tracker.predict(frame_index=k)
        assert tracks.ids.tolist() == [1, 2] or k < 2 * every
    np.testing.assert_allclose(tracker.extrapolated(frame_index=12 * every).ids, [1, 2])


@pytest.mark.parametrize("every", [17, 30, 60])
def test_what_a_slow_machine_misses_once_keeps_its_id(every):
    """A car would have a new number after each look that misses it; one that has stopped would be another."""
    tracker, box = ByteTracker(fps=15), (100, 100, 140, 160)
    found = [True, True, False, True, False, True, True, False, False, True]
    shown = [seen(box) if one else Detections.none() for one in found]
    listed = [tracker.update(one, frame_index=k * every).ids.tolist() for k, one in enumerate(shown)]
    assert listed == [[1] if one else [] for one in found]
    tracker = ByteTracker(fps=15)
    drove = [seen((x, 100, x + 100, 150)) for x in (0, 150, 300, 450, 600, 600, 600)]
    listed = [tracker.update(one, frame_index=30 * look).ids.tolist() for look, one in enumerate(drove)]
    assert listed == [[1]] * 7


def test_nothing_is_listed_of_a_picture_that_is_long_past():
    """The map would show where cars were; after a long interruption all are new."""
    tracker, box = ByteTracker(fps=15), (100, 100, 140, 160)
    for k in range(0, 30, 5):
        tracker.update(seen(box), frame_index=k)
    listed = [len(tracker.predict(frame_index=k)) for k in range(30, 300)]
    assert listed == [1] * 18 + [0] * 252, "a second and a half after the last look"
    tracker = ByteTracker(fps=15)
    listed = [tracker.update(seen(box), frame_index=k).ids.tolist() for k in (0, 1, 12, 900, 901)]
    assert listed == [[1]] * 3 + [[], [2]]


def test_gaps_are_stepped_like_predicted_frames():
    """Frames that the link lost would shift every box."""
    a, b = ByteTracker(fps=15), ByteTracker(fps=15)
    for k in (0, 1, 2, 3, 8):
        box = (100 + 5 * k, 100, 140 + 5 * k, 160)
        for between in range(4, 8) if k == 8 else ():
            b.predict(frame_index=between)
        left, right = a.update(seen(box), frame_index=k), b.update(seen(box), frame_index=k)
    np.testing.assert_array_equal(left.boxes_xyxy_px, right.boxes_xyxy_px)


@given(seed=seeds, ahead=st.integers(0, 80))
@settings(max_examples=40)
def test_looking_ahead_shows_what_prediction_would_and_changes_nothing(seed, ahead):
    """A list shown between two frames would differ from the track, or move it."""
    asked, other = ByteTracker(fps=15), ByteTracker(fps=15)
    detections = scene(seed)
    for tracker in (asked, other):
        run(tracker, detections[:-1], every=2)
    before = other.update(detections[-1], frame_index=20)
    assert asked.update(detections[-1], frame_index=20).ids.tolist() == before.ids.tolist()
    shown = asked.extrapolated(frame_index=20 + ahead)
    asked.extrapolated(frame_index=50)
    foreseen = other.predict(frame_index=20 + ahead) if ahead else before
    assert shown.frame_index == foreseen.frame_index
    assert shown.ids.tolist() == foreseen.ids.tolist()
    np.testing.assert_array_equal(shown.boxes_xyxy_px, foreseen.boxes_xyxy_px)
    assert shown.seen_frames.tolist() == foreseen.seen_frames.tolist()
    assert not shown.started.any()
    if ahead < 15:  # further ahead one step ends all tracks where two do not
        np.testing.assert_array_equal(
            asked.predict(frame_index=20 + ahead + 1).boxes_xyxy_px,
            other.predict(frame_index=20 + ahead + 1).boxes_xyxy_px,
        )
    asked.predict(frame_index=200)
    with pytest.raises(ValueError, match="must not be below"):
        asked.extrapolated(frame_index=20 + ahead)


def test_between_detections_a_box_hardly_grows_by_itself():
    """What drove by close to the camera would leave a box that grows over half of the picture."""
    tracker = ByteTracker(fps=15)
    for k in range(0, 10, 5):
        last = seen((100 - 3 * k, 100 - 2 * k, 140 + 3 * k, 130 + 2 * k))
        tracker.update(last, frame_index=k)
    sides = [
        np.diff(one.boxes_xyxy_px.reshape(2, 2), axis=0)[0]
        for one in (
            tracker.predict(frame_index=6),
            tracker.extrapolated(frame_index=26),
            tracker.predict(frame_index=26),
        )
    ]
    assert max(sides[1].max() / sides[0].max(), sides[2].max() / sides[0].max()) < 1.2


@pytest.mark.parametrize("late", [0, 3])
def test_between_detections_a_box_goes_with_what_is_in_it(late):
    """A car that turns or brakes, and one that comes closer, would lose its box until the detector looks again."""
    rng = np.random.default_rng(0)
    ground, car = (
        cv2.blur(rng.integers(0, 255, (*size, 3), np.uint8), (5, 5)) for size in ((360, 640), (40, 60))
    )
    tracker = ByteTracker(TrackerSettings(camera_motion="flow"), fps=15)
    x, y, side = 100.0, 100.0, 1.0
    for k in range(30):
        x, y = (x + 6, y) if k <= 10 else (x - 1, y + 5)
        side *= 1 if k <= 10 else 1.02
        image = np.roll(np.asarray(ground, np.uint8), 2 * k, axis=1)
        shown = cv2.resize(car, None, fx=side, fy=side)
        image[round(y) : round(y) + shown.shape[0], round(x) : round(x) + shown.shape[1]] = shown
        box = (round(x), round(y), round(x) + shown.shape[1], round(y) + shown.shape[0])
        begins = k % 5 == 0 and k <= 10
        listed = tracker.predict(frame_index=k, image=image, searched=begins)
        if begins:
            found = seen(box)
        if k % 5 == late and k - late <= 10:
            tracker.update_late(found)
        if k > 10 + late:
            assert iou(listed.boxes_xyxy_px, np.array([box], np.float32))[0, 0] > 0.7, k


def test_boxes_keep_to_their_objects_where_frames_come_without_a_picture():
    """An edge that codes each third frame would cut its stills beside the cars."""
    rng = np.random.default_rng(1)
    ground, car = (
        cv2.blur(rng.integers(0, 255, (*size, 3), np.uint8), (5, 5)) for size in ((360, 640), (30, 44))
    )
    tracker = ByteTracker(TrackerSettings(camera_motion="flow"), fps=30)
    for k in range(80):
        x = 40 + 6 * k
        image = np.asarray(ground, np.uint8).copy()
        image[150:180, x : x + 44] = car
        given = image if k % 3 == 0 else None
        if k % 9 == 0:
            listed = tracker.update(seen((x, 150, x + 44, 180)), frame_index=k, image=given)
        else:
            listed = tracker.predict(frame_index=k, image=given)
        if k > 27:
            assert abs(listed.boxes_xyxy_px[-1, 0] - x) < 2, k


def test_a_detection_every_four_seconds_has_boxes_between_them_from_the_first_on():
    """On a slow machine the map would be empty most of the time."""
    listed = run(ByteTracker(fps=15), [seen((100, 100, 140, 160))] * 180, every=60)
    assert [len(tracks) for tracks in listed] == [1] * 180


def test_a_frame_of_hours_later_costs_no_steps_in_between(monkeypatch):
    """A forged frame number would hold up the ground for hours."""
    steps = []
    step = kalman.predict
    monkeypatch.setattr(kalman, "predict", lambda states: (steps.append(1), step(states)))
    tracker = ByteTracker(TrackerSettings(camera_motion="flow"), fps=15)
    image = np.asarray(np.random.default_rng(0).integers(0, 255, (180, 320, 3)), np.uint8)
    tracker.update(seen((100, 100, 140, 160)), frame_index=0, image=image)
    assert len(tracker.predict(frame_index=2**32 - 1, image=image)) == 0
    assert len(steps) < 10


def test_what_is_found_in_a_picture_of_long_ago_is_not_shown():
    """A detector that loads for three seconds would put the first picture's boxes on nothing."""
    tracker = ByteTracker(fps=15)
    for k in range(40):
        tracker.predict(frame_index=k, searched=k == 0)
    tracker.update_late(seen((100, 100, 140, 160)))
    assert len(tracker.predict(frame_index=40)) == 0
    tracker.update(seen((100, 100, 140, 160)), frame_index=41)
    assert tracker.predict(frame_index=42).ids.tolist() == [1]


def test_a_small_box_does_not_go_with_the_ground():
    """A walker would be carried along with the field around, and be lost."""
    before = np.asarray(
        cv2.blur(np.random.default_rng(2).integers(0, 255, (180, 320), np.uint8), (5, 5)), np.uint8
    )
    boxes = np.array([[100.0, 100, 114, 124], [200, 100, 240, 140]])
    moved = box_flow(before, np.roll(before, 2, axis=1), boxes, expected=np.zeros((2, 2)), size=(640, 360))
    assert moved.found.tolist() == [False, True]
    np.testing.assert_allclose(moved.shifts[1], (4, 0), atol=0.2)


def test_a_small_car_goes_its_own_way_and_not_the_grounds():
    """Its box would stay behind until the detector looks again: a window that is wider than the car sees the road."""
    right = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        ground, car = (
            cv2.blur(rng.integers(0, 255, size, np.uint8), (side, side))
            for size, side in (((180, 320), 5), ((12, 16), 3))
        )
        before, now = (np.roll(np.asarray(ground, np.uint8), by, axis=1) for by in (0, -2))
        before[80:92, 100:116] = now[80:92, 103:119] = car
        box = np.array([[200.0, 160, 232, 184]])
        moved = box_flow(before, now, box, expected=np.zeros((1, 2)), size=(640, 360))
        right += bool(moved.found[0] and np.abs(moved.shifts[0] - (6, 0)).max() < 1.5)
    assert right >= 34


def test_a_frame_costs_a_bounded_number_of_pixels_to_follow(monkeypatch):
    """Sixty cars would take twice the processor, which video needs."""
    pixels = []
    follow = cv2.calcOpticalFlowPyrLK

    def counted(before, now, points, guess, **settings):
        pixels.append(len(points) * np.prod(settings["winSize"]) * (settings["maxLevel"] + 1))
        return follow(before, now, points, guess, **settings)

    monkeypatch.setattr(cv2, "calcOpticalFlowPyrLK", counted)
    rng = np.random.default_rng(4)
    picture = cv2.blur(rng.integers(0, 255, (720, 1280, 3), np.uint8), (9, 9))
    corners = rng.uniform((20, 20), (1200, 640), (60, 2))
    boxes = np.hstack((corners, corners + 40))
    tracker = ByteTracker(TrackerSettings(camera_motion="flow"), fps=15)
    tracker.update(seen(*boxes), frame_index=0, image=np.asarray(picture, np.uint8))
    tracker.predict(frame_index=1, image=np.roll(np.asarray(picture, np.uint8), 3, axis=1))
    assert len(pixels) == 2  # the camera, and the boxes
    assert sum(pixels) <= 360_000


def test_a_box_alone_goes_as_among_others_and_one_beside_the_picture_nowhere():
    """The part of the pictures that is looked at would change what is seen there."""
    before = np.asarray(
        cv2.blur(np.random.default_rng(3).integers(0, 255, (360, 640), np.uint8), (5, 5)), np.uint8
    )
    now = np.roll(before, (1, 3), axis=(0, 1))
    boxes = np.array(
        [[300.0, 200, 360, 250], [20, 20, 80, 80], [1200, 620, 1270, 700], [5000, 100, 5080, 180]]
    )
    moved = [
        box_flow(before, now, boxes[rows], expected=np.zeros((len(rows), 2)), size=(1280, 720))
        for rows in ([0], [0, 1, 2], [3])
    ]
    np.testing.assert_allclose(moved[0].shifts[0], (6, 2), atol=0.1)
    np.testing.assert_allclose(moved[0].shifts[0], moved[1].shifts[0], atol=0.01)
    assert [one.found.tolist() for one in moved] == [[True], [True] * 3, [False]]


def test_a_box_that_goes_with_the_road_does_not_grow_with_it():
    """A car has left, and the camera flies on: its box would grow over half of the picture."""
    picture = cv2.blur(np.random.default_rng(1).integers(0, 255, (720, 1280, 3), np.uint8), (7, 7))
    tracker = ByteTracker(TrackerSettings(camera_motion="flow"), fps=15)
    box = (600, 340, 680, 380)
    for k in range(20):
        affine = cv2.getRotationMatrix2D((640, 360), 0, 1.06**k)
        image = np.asarray(cv2.warpAffine(picture, affine, (1280, 720)), np.uint8)
        if k == 0:
            tracker.update(seen(box), frame_index=k, image=image)
        else:
            listed = tracker.predict(frame_index=k, image=image)
    assert 1.5 < float(np.diff(listed.boxes_xyxy_px[0, ::2])[0]) / 80 < 1.65


@pytest.mark.parametrize("late", [0, 2, 4])
def test_what_is_found_late_counts_as_if_it_had_been_found_at_once(late):
    """Boxes of a slow detector would lie where objects were when it began."""
    at_once, waited = (ByteTracker(TrackerSettings(camera_motion="flow"), fps=15) for _ in range(2))
    picture = np.random.default_rng(late).integers(0, 255, (90, 160, 3), np.uint8)
    for k, found in enumerate(scene(late, frames=20)):
        image = np.roll(picture, 3 * k, axis=1)  # the camera pans
        if k % 5 == 0:
            at_once.update(found, frame_index=k, image=image)
        else:
            at_once.predict(frame_index=k, image=image)
        waited.predict(frame_index=k, image=image, searched=k % 5 == 0)
        if k % 5 == 0:
            searched = found
        if k % 5 == late:
            assert waited.update_late(searched).frame_index == k - late
            for name, column in asdict(at_once.extrapolated(frame_index=k)).items():
                np.testing.assert_array_equal(getattr(waited.extrapolated(frame_index=k), name), column)
            for frames in range(4, 16):
                due = [one.is_due(frames, every=5, most=15) for one in (waited, at_once)]
                assert due[0] == due[1]
    with pytest.raises(ValueError, match="no frame is being searched"):
        waited.update_late(Detections.none())


def test_what_goes_on_as_predicted_is_searched_less_often_until_something_is_new_or_missed():
    """Half of the processor would go into what is known; or a car that drives in be listed seconds later."""
    tracker = ByteTracker(TrackerSettings(), fps=15)

    at = 0

    def first_due(*boxes):
        nonlocal at
        tracker.update(seen(*boxes), frame_index=at)
        assert tracker.is_due(5, every=5, most=5), "as given"
        frames = next(n for n in range(1, 99) if tracker.is_due(n, every=5, most=12))
        at += frames
        return frames

    def cars(number):
        return [(2 * at, 60 * k, 2 * at + 40, 60 * k + 40) for k in range(number)]  # they drive on

    assert [first_due(*cars(12)) for _ in range(3)] == [5, 10, 12]
    assert [first_due(*cars(13)) for _ in range(2)] == [5, 12], "one more is confirmed soon"
    assert [first_due(*cars(10)) for _ in range(3)] == [5, 10, 12], "three are gone"
    assert [first_due() for _ in range(2)] == [5, 5], "nothing is known"


def test_a_detector_that_hangs_takes_no_more_memory_with_each_frame():
    """A ground that shows video for days would keep a step of each frame since."""
    hanging, at_once = (ByteTracker(fps=15) for _ in range(2))
    at_once.update(seen((0, 0, 40, 40)), frame_index=0)
    hanging.predict(frame_index=0, searched=True)
    tracemalloc.start()
    try:
        for k in range(1, 1000):
            hanging.predict(frame_index=k)
        assert tracemalloc.get_traced_memory()[0] < 20_000
    finally:
        tracemalloc.stop()
    at_once.predict(frame_index=999)
    assert hanging.update_late(seen((0, 0, 40, 40))).ids.tolist() == [1]
    assert len(hanging.extrapolated(frame_index=999)) == len(at_once.extrapolated(frame_index=999)) == 0


def test_the_class_follows_the_votes():
    """A car seen once as a truck would change its label, or a wrong first label would stay for ever."""
    tracker, box = ByteTracker(fps=30), (0, 0, 40, 40)

    def after(first, classes):
        return [
            int(tracker.update(seen(box, confidence=c, class_id=k), frame_index=first + n).class_ids[0])
            for n, (k, c) in enumerate(classes)
        ]

    assert after(0, [(2, 0.9), (2, 0.9), (5, 0.3), (2, 0.9)]) == [2, 2, 2, 2]
    assert after(4, [(7, 0.9)] * 12)[-1] == 7


def test_unusable_detections_are_left_out():
    """One NaN from a detector would spread to every box."""
    nan, inf = float("nan"), float("inf")
    good = (100, 100, 140, 160)
    bad = [
        (nan, 0, 1, 1),
        (0, 0, inf, 9),
        (-inf, 0, inf, 9),
        (50, 50, 40, 60),
        (5, 5, 5, 9),
        (0, 0, 3e38, 3e38),
    ]
    tracker = ByteTracker(fps=30)
    for k in range(3):
        detections = seen(good, *bad, (300, 300, 330, 330))
        detections.confidences[-1] = nan
        tracks = tracker.update(detections, frame_index=k)
        assert tracks.ids.tolist() == [1]
        np.testing.assert_allclose(tracks.boxes_xyxy_px, [good])


def test_tiny_boxes_are_not_listed_but_keep_their_id():
    """Specks would fill the map."""
    for least_px2, count in ((TrackerSettings().min_box_area_px2, 0), (0, 1)):
        tracker = ByteTracker(TrackerSettings(min_box_area_px2=least_px2), fps=30)
        assert len(tracker.update(seen((0, 0, 3, 3)), frame_index=0)) == count


def test_results_do_not_change_and_trackers_share_nothing():
    """What is being drawn would change; a second camera would go on with the numbers of the first."""
    a, b = ByteTracker(fps=30), ByteTracker(fps=30)
    first = a.update(seen((0, 0, 40, 40)), frame_index=5)
    before = first.boxes_xyxy_px.copy(), first.started.copy(), first.confidences.copy()
    a.update(seen((3, 3, 43, 43), confidence=0.7), frame_index=6)
    for kept, now in zip(before, (first.boxes_xyxy_px, first.started, first.confidences), strict=True):
        np.testing.assert_array_equal(kept, now)
    a.reset()
    for one in (b, a):
        assert one.update(seen((0, 0, 40, 40)), frame_index=0).ids.tolist() == [1]


def test_wrong_calls_are_refused():
    """A bug in the order of frames would be a jump on the map."""
    tracker = ByteTracker(fps=30)
    tracker.update(Detections.none(), frame_index=3)
    with pytest.raises(ValueError, match="frame_index is 3"):
        tracker.predict(frame_index=3)
    with pytest.raises(ValueError, match="class_ids holds -1"):
        tracker.update(seen((0, 0, 9, 9), class_id=-1), frame_index=4)
    for fps in (0, -1, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="fps is"):
            ByteTracker(fps=fps)
    wrong: Any = {"track_confidence": 1.5, "low_confidence": 0.6, "match_iou": -0.1, "track_buffer": -1}
    wrong |= {"min_box_area_px2": float("nan"), "search_growth_per_s": -1.0, "class_decay": 2.0}
    for setting, value in (wrong | {"camera_motion": "magic"}).items():
        with pytest.raises(ValueError, match=setting):
            TrackerSettings(**{setting: value})
