"""One access unit from the link to the list of tracks, through real parts: how many files it walks through."""

import sys
import threading
import time

import pytest

from hvt_common.protocol.messages import Info
from hvt_ground.events import Event, Overlay, VideoSample
from hvt_ground.session.edge_port import ReceiverReports
from hvt_ground.session.edge_sessions import EdgeSessions
from hvt_ground.session.session import Session
from programs.processes import eventually
from rigs.flight import Flight, Port, pipeline_of

TO_THE_PICTURE, TO_THE_TRACKS = 10, 12
"""Files of the ground that a frame enters at most in the receiving thread, and in those of perception."""


class Events(list[Event]):
    """A sink that lists what it gets."""

    log = list.append

    def close(self, hurry=None) -> None:
        """Nothing."""


class Walk:
    """Files of the ground in which functions were called, by thread."""

    def __init__(self) -> None:
        self.files: dict[str, set[str]] = {}

    def profile(self, frame, event, _argument) -> None:
        """What `sys.setprofile` takes."""
        name = frame.f_code.co_filename
        if event == "call" and "hvt_ground" in name:
            thread = threading.current_thread().name
            self.files.setdefault(thread, set()).add(name.partition("hvt_ground/")[2])


@pytest.fixture
def walk():
    """Counts in every thread that begins from now on, and in this one where the test says so."""
    walk = Walk()
    threading.setprofile(walk.profile)
    yield walk
    threading.setprofile(None)


def test_a_frame_walks_through_few_files(walk: Walk) -> None:
    """Who looks for a fault in the picture would have to read half the ground."""
    flight, port, sink = Flight(8), Port(), Events()
    port.flight = flight

    def open_session(info: Info, reports: ReceiverReports) -> Session:
        return Session(info, sinks=[sink], pipeline_of=pipeline_of, clock=time.time_ns, reports=reports)

    edge = EdgeSessions(port, open_session=open_session)  # type: ignore[arg-type]
    for index in range(7):
        edge.handle(flight.base(index))
    assert edge.session is not None
    eventually(lambda: edge.session.idle)
    walk.files.clear()
    sink.clear()
    before = sys.getprofile()
    sys.setprofile(walk.profile)
    edge.handle(flight.base(7))
    sys.setprofile(before)
    eventually(lambda: edge.session.idle)
    assert [one.frame_index for one in sink if isinstance(one, VideoSample | Overlay)][:2] == [7, 7]
    receiving = walk.files.pop(threading.current_thread().name)
    analyzing = set[str]().union(*walk.files.values())  # worker and detector have a thread each
    assert len(receiving) <= TO_THE_PICTURE, sorted(receiving)
    assert len(analyzing) <= TO_THE_TRACKS, sorted(analyzing)
    edge.close()
