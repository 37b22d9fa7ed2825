"""When a track is reported, and what motion it has."""

from itertools import pairwise

import pytest

from hvt_common.geodesy import moved
from hvt_common.units import SECOND_NS
from hvt_gateways.cot.schedule import STALE_NS, MotionTrail, PlacedTrack, TrackSchedule

HERE = (52.0, 13.0)


def track(track_id: int = 1, **changes) -> PlacedTrack:
    values = {"place": HERE, "error_m": 4.0, "name": "car", "base_name": "car", "confidence": 0.8}
    return PlacedTrack(track_id=track_id, **{**values, "refined": False, "sure": False, **changes})


def away(north_m: float, east_m: float = 0.0) -> tuple[float, float]:
    return moved(*HERE, north_m=north_m, east_m=east_m)


def reports(schedule: TrackSchedule, *, lasts_s: float, speed_mps: float) -> list[float]:
    """When one of 15 frames a second is reported, seconds."""
    times = [frame / 15 for frame in range(round(lasts_s * 15))]
    return [
        at_s
        for at_s in times
        if schedule.due([track(place=away(speed_mps * at_s))], now_ns=round(at_s * SECOND_NS))
    ]


def test_what_moves_is_reported_once_a_second_and_what_stands_before_it_goes_stale():
    """A radio net of ten users would carry each frame, or what stands would vanish from the map."""
    moving, standing = (reports(TrackSchedule(), lasts_s=30, speed_mps=speed_mps) for speed_mps in (10, 0.05))
    pauses = [after - before for before, after in pairwise(moving)]
    assert min(pauses) >= 1.0
    assert max(pauses) < 1.1
    pauses = [after - before for before, after in pairwise(standing)]
    assert min(pauses) >= 3.0
    assert max(pauses) < STALE_NS / SECOND_NS - 1, "one report may be lost on the way"


def test_another_class_is_reported_at_once_a_second():
    """What a still has just refined would be called what it is not for two seconds more."""
    schedule = TrackSchedule()
    assert schedule.due([track()], now_ns=0)
    assert not schedule.due([track()], now_ns=SECOND_NS)
    assert schedule.due([track(name="truck")], now_ns=SECOND_NS)


def test_in_a_crowd_refined_and_confident_tracks_go_first():
    """The one that an operator has a still of would be missing among hundreds of guesses."""
    schedule = TrackSchedule(most_a_second=10)
    crowd = [track(one, confidence=one / 1000, refined=one % 50 == 0) for one in range(1, 501)]
    first = schedule.due(crowd, now_ns=0)
    assert [one.track_id for one in first] == [500, 450, 400, 350, 300, 250, 200, 150, 100, 50]
    assert schedule.due(crowd, now_ns=SECOND_NS // 2)[0].track_id == 499
    count = 15 + sum(
        len(schedule.due(crowd, now_ns=SECOND_NS // 2 + frame * SECOND_NS // 15)) for frame in range(1, 151)
    )
    assert 90 <= count <= 116, "ten a second"


def test_a_flood_of_tracks_is_forgotten_again():
    """A flight of weeks would fill the memory with objects of the first day."""
    schedule = TrackSchedule(most_a_second=10**6)
    for minute in range(3):
        many = [track(minute * 10**5 + one) for one in range(10_000)]
        assert len(schedule.due(many, now_ns=minute * 61 * SECOND_NS)) == 10_000
    back = schedule.due([track(1)], now_ns=3 * 61 * SECOND_NS)
    assert len(back) == 1, "it is reported like a new one"


@pytest.mark.parametrize(
    ("north_mps", "east_mps", "course_deg"), [(10, 0, 0), (0, 8, 90), (-6, 0, 180), (3, -3, 315)]
)
def test_course_and_speed(north_mps, east_mps, course_deg):
    """The arrow on the map would point where nothing goes."""
    trail = MotionTrail()
    for second in range(12):
        motion = trail.add(second * SECOND_NS, away(north_mps * second, east_mps * second), error_m=3.0)
        assert (motion is None) == (second == 0 or second * (north_mps**2 + east_mps**2) ** 0.5 <= 3)
    assert (motion.course_deg + 1) % 360 - 1 == pytest.approx(course_deg, abs=0.5)
    assert motion.speed_mps == pytest.approx((north_mps**2 + east_mps**2) ** 0.5, rel=0.01)


def test_what_trembles_within_its_error_does_not_move():
    """A parked car would drive around on the map."""
    trail = MotionTrail()
    for second in range(60):
        assert trail.add(second * SECOND_NS, away((-1) ** second * 1.5), error_m=4.0) is None


def test_what_has_stopped_stands_ten_seconds_later():
    """It would go on for ever."""
    trail = MotionTrail()
    for second in range(5):
        trail.add(second * SECOND_NS, away(10 * second), error_m=3.0)
    assert trail.add(7 * SECOND_NS, away(40), error_m=3.0) is not None
    for second in range(8, 16):
        motion = trail.add(second * SECOND_NS, away(40), error_m=3.0)
    assert motion is None
    assert trail.add(8 * SECOND_NS, away(500), error_m=3.0) is None, "time does not go back"


def test_one_place_of_the_future_does_not_end_course_and_speed():
    """A pose with a wrong time, or a clock that is set back, would take the arrow from the map for the flight."""
    trail = MotionTrail()
    assert trail.add(10**6 * SECOND_NS, away(0), error_m=3.0) is None
    motions = [trail.add(second * SECOND_NS, away(10 * second), error_m=3.0) for second in range(3)]
    assert motions[-1] is not None
