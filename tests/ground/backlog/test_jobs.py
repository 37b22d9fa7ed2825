"""Jobs of the backlog that a session's end overtakes: the recording that they hold is let go."""

from __future__ import annotations

import threading

from hvt_common.protocol.messages import parse_backlog_units
from hvt_common.tracking.bytetrack import ByteTracker, TrackerSettings
from hvt_ground.backlog.jobs import Destination, VideoJob
from hvt_ground.backlog.perception import BacklogPerception
from hvt_ground.backlog.session_backlog import SessionBacklog
from hvt_ground.perception.worker import RealtimeWorker
from programs.processes import eventually
from rigs.backlog_chunks import video_object
from rigs.flight import Flight, RedSquares, SameAnswer


def test_work_that_was_never_begun_lets_its_recording_go():
    """The recording of a former session would stay open for ever, and with each such session one more."""
    flight = Flight(30, keyframes=(10,))
    info, units = flight.info(), parse_backlog_units(video_object(flight, range(10, 20)))
    last_shown, go_on = threading.Event(), threading.Event()
    users: list[SessionBacklog] = []

    def log(event) -> None:
        if event.frame_index == units[-1].frame_index:
            last_shown.set()
            go_on.wait(timeout=20)

    perception = BacklogPerception(
        info,
        take_models=lambda: (RedSquares(), None),
        tracker_of=lambda: ByteTracker(TrackerSettings.starting_at(0.25, camera_motion="off"), fps=15),
        reader_of=lambda _detector, _classifier: SameAnswer(),
        detect_every=3,
    )
    former = SessionBacklog(info, log=log, perception=perception, read=lambda _still: None)
    destination = Destination(lambda: users.append(former) or former, users.remove)
    worker = RealtimeWorker(
        lambda *_: None, lambda *_: None, lambda _stills: None, name="x", finish_s=0.1, leave_s=0.1
    )
    outcomes: list[bool | None] = []
    worker.submit(VideoJob(units, destination, worker=worker, done=outcomes.append))
    assert last_shown.wait(timeout=20)
    never = VideoJob(units, destination, worker=worker, done=outcomes.append)
    worker.submit(never)
    assert users == [former], "one that waits has nothing in hand"
    assert not worker.close(), "it is in the middle of a frame when the session ends"
    go_on.set()
    eventually(lambda: not users, within_s=20, what="the boxes that were to be found hold nothing either")
    assert None not in outcomes
