"""When a pose is told to the ground."""

import pytest

from hvt_common.protocol.messages import PoseDecoder, PoseReport
from hvt_common.runtime.failures import Failures
from hvt_common.values import Pose
from hvt_edge.loop.pose import PoseStage, PoseTable

SECOND_NS = 1_000_000_000
START_NS = 1_790_000_000_000_000_000


class Sent:
    """What would have left, with its time."""

    def __init__(self, full_ns: range = range(0)) -> None:
        self.messages: list[tuple[int, bytes]] = []
        self.full_ns = full_ns

    def metadata(self, _channel, make, *, now_ns):
        """Take it at once, if there is room."""
        if now_ns in self.full_ns:
            return False
        self.messages.append((now_ns, make(now_ns)))
        return True


def fly(table: PoseTable, *, seconds: int, fps: int = 15, full_ns: range = range(0)) -> tuple[Sent, Failures]:
    """Every frame of a flight; at times of ``full_ns`` the budget has no room."""
    sent, failures = Sent(full_ns), Failures(lambda: START_NS)
    stage = PoseStage(table, session_id=5, sender=sent, failures=failures)
    for index in range(seconds * fps):
        media_ns = index * SECOND_NS // fps
        stage.step(media_ns, capture_ns=START_NS + media_ns, now_ns=START_NS + media_ns)
    return sent, failures


MINUTE = [Pose(0, 52.0, 13.0, height_m=80.0), Pose(60 * SECOND_NS, 52.01, 13.01, height_m=90.0)]


def test_it_is_told_once_a_second_and_within_300_bits():
    """It would eat the stills of a thin link."""
    sent, failures = fly(PoseTable(MINUTE, most_gap_s=99), seconds=60)
    bits = 8 * sum(len(data) for _, data in sent.messages)
    assert 50 <= len(sent.messages) <= 60
    assert bits / 60 <= 300
    decoder = PoseDecoder()
    poses = [decoder.decode(PoseReport.parse(data)) for _, data in sent.messages]
    assert all(pose is not None for pose in poses)
    assert [pose.capture_ns for pose in poses if pose] == [at for at, _ in sent.messages]
    assert failures.parts == ()


def test_without_room_it_is_told_at_the_next_frame_and_understood():
    """A ground would read changes of a report that never came, and show no place for ten seconds."""
    full_ns = range(START_NS + 5 * SECOND_NS // 2, START_NS + 9 * SECOND_NS // 2)
    sent, _ = fly(PoseTable(MINUTE, most_gap_s=99), seconds=8, full_ns=full_ns)
    decoder = PoseDecoder()
    assert all(decoder.decode(PoseReport.parse(data)) is not None for _, data in sent.messages)
    after = [at for at, _ in sent.messages if at >= full_ns.stop]
    assert after[0] - full_ns.stop <= SECOND_NS // 15


def test_where_there_is_none_it_says_so_and_goes_on():
    """A flight would stop, or its map stay where it was without a word."""
    sent, failures = fly(PoseTable([Pose(0, 52.0, 13.0), Pose(2 * SECOND_NS, 52.0, 13.0)]), seconds=8)
    assert len(sent.messages) in (3, 4)
    (part,) = failures.parts
    assert (part.part, part.working) == ("pose", False)
    assert "has nothing at" in part.reason


class Broken:
    """Raises where a pose is asked for, or else where its trouble is."""

    def __init__(self, error: BaseException | None) -> None:
        self.error = error

    @property
    def trouble(self) -> str:
        return str(1 // 0)

    def at(self, media_ns, *, capture_ns):
        if self.error is not None:
            raise self.error


@pytest.mark.parametrize("error", [ValueError("hm"), SystemExit(1), None])
def test_an_error_in_the_source_of_poses_ends_no_flight(error):
    """Video would end over a message of the autopilot that nobody had thought of."""
    sent, failures = fly(Broken(error), seconds=3)
    assert sent.messages == []
    assert failures.parts[0].reason.startswith(type(error or ZeroDivisionError()).__name__)


def test_where_none_is_expected_none_is_missed():
    """The log said "pose: ; all else goes on"."""
    table = PoseTable([Pose(0, 52.0, 13.0)])
    table.at = lambda media_ns, *, capture_ns: None
    assert fly(table, seconds=3)[1].parts == ()


def test_a_number_that_cannot_be_said_is_named():
    """A broken sensor would end the flight."""
    high = [Pose(0, 52.0, 13.0, height_m=1e9), Pose(9 * SECOND_NS, 52.0, 13.0, height_m=1e9)]
    sent, failures = fly(PoseTable(high), seconds=3)
    assert sent.messages == []
    assert "height" in failures.parts[0].reason
