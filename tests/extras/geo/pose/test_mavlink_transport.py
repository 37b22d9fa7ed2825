"""An autopilot behind a TCP server or a serial device, which come and go."""

import os
import socket
import threading
import time
from contextlib import closing

import pytest

from programs.processes import eventually

pytest.importorskip("pymavlink")


from hvt_edge.loop.pose import open_pose
from hvt_geo.pose.mavlink_transport import MAX_FRAME_BYTES, Address, Connection, FrameParser


def opened(address: str):
    return open_pose(f"mavlink:{address}", hfov_deg=None, clock=time.time_ns)


def test_a_server_that_is_gone_at_the_end_ends_no_flight_with_a_traceback(autopilot, wait_for, capfd):
    """The summary of the flight would be lost to an error of its last second."""
    server = socket.create_server(("127.0.0.1", 0))
    source = opened(f"tcp:127.0.0.1:{server.getsockname()[1]}")
    other, _ = server.accept()
    wait_for(source, say=lambda: other.sendall(autopilot().place()))
    server.close()
    other.close()
    eventually(lambda: source.at(0, capture_ns=0) is None)
    assert "s old (" in source.trouble  # and why
    source.close()
    assert capfd.readouterr() == ("", "")


def test_a_server_that_comes_again_is_found_again(autopilot, wait_for):
    """An autopilot that restarts would be lost for the rest of the flight."""
    server = socket.create_server(("127.0.0.1", 0))
    port = server.getsockname()[1]
    source = opened(f"tcp:127.0.0.1:{port}")
    try:
        other, _ = server.accept()
        wait_for(source, say=lambda: other.sendall(autopilot().place()))
        server.close()
        other.close()
        eventually(lambda: source.at(0, capture_ns=0) is None)
        with socket.create_server(("127.0.0.1", port)) as again:
            again.settimeout(60)
            other, _ = again.accept()
            with other:
                pose = wait_for(source, say=lambda: other.sendall(autopilot().place(48.2)))
        assert pose.latitude_deg == pytest.approx(48.2)
    finally:
        source.close()


def test_a_server_that_falls_silent_is_called_again():
    """A bridge that lost its power would leave a line on which nothing comes any more, and nobody would know."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(60)
        address = Address.parse(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        connection = Connection(address, stop=threading.Event(), silent_s=0.4)
        with server.accept()[0]:
            eventually(lambda: connection.read() or connection.trouble)
            assert "said nothing" in connection.trouble
            eventually(lambda: connection.read() == b"")
            with server.accept()[0] as second:
                second.sendall(b"again")
                eventually(lambda: connection.read() == b"again")
        assert connection.trouble == ""
        connection.close()


def test_a_server_that_does_not_answer_is_refused_soon():
    """The start would hang, and Ctrl-C not end it."""
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen(0)
        port = server.getsockname()[1]
        waiting = [socket.socket() for _ in range(4)]
        for one in waiting:  # they fill the queue of those that are not accepted yet
            one.setblocking(False)
            one.connect_ex(("127.0.0.1", port))
        try:
            with closing(opened(f"tcp:127.0.0.1:{port}")) as source:
                assert "timed out" in source.trouble
        finally:
            for one in waiting:
                one.close()


def test_it_sends_a_server_nothing(autopilot, wait_for):
    """What is only to watch would take part in the control of a vehicle."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        source = opened(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        with server.accept()[0] as other:
            try:
                other.sendall(autopilot().heartbeat() + autopilot().place())
                wait_for(source)
            finally:
                source.close()
            assert other.recv(1) == b""


def test_an_autopilot_on_a_cable(autopilot, wait_for):
    """The usual way on a drone: the flight controller's own serial port."""
    ours, theirs = os.openpty()
    source = opened(f"{os.ttyname(theirs)},57600")
    os.close(theirs)
    try:
        pose = wait_for(source, say=lambda: os.write(ours, b"noise" + autopilot().place()))
        assert pose.latitude_deg == pytest.approx(47.1)
        os.close(ours)  # the plug is pulled
        eventually(lambda: source.at(0, capture_ns=0) is None)
        assert "s old (" in source.trouble
    finally:
        source.close()


def test_a_stream_that_is_never_read_at_the_end_of_a_frame_fills_no_memory(autopilot):
    """A flight of hours over a cable would slowly take all of it."""
    parser = FrameParser(is_stream=True)
    frame = autopilot().place()
    found = parser.messages(frame[:7])
    for _ in range(3000):
        found += parser.messages(frame[7:] + frame[:7])
        assert len(parser.rest) <= MAX_FRAME_BYTES
    assert len(found) == 3000


@pytest.mark.parametrize("begun", [b"\xfd\xff\x00\x00", b"\xfe\xff\x00", b"\xfd", b"garbage"])
def test_a_stranger_s_datagram_takes_nothing_from_the_next(autopilot, begun):
    """A few bytes a second from anybody would hide the autopilot."""
    parser = FrameParser(is_stream=False)
    parser.messages(begun)
    (message,) = parser.messages(autopilot().place())
    assert message.get_type() == "GLOBAL_POSITION_INT"
