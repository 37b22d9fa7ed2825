"""The stream as players and KLV readers have it."""

import json
import shutil
import socket
import subprocess
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hvt_common.errors import UserError
from hvt_common.runtime.failures import Failures
from hvt_common.units import SECOND_NS
from hvt_common.values import Orientation, Pose, View
from hvt_common.video.hevc import BaseDecoder, nal_units, parameter_sets
from hvt_gateways.transport_stream.destination import Address, Addresses
from hvt_gateways.transport_stream.stream import TransportStream, live_stream, stream_file
from hvt_gateways.transport_stream.uas import Platform
from hvt_ground.events import Event, Overlay, PoseUpdate, VideoSample
from hvt_ground.sinks import QueuedSink
from media.klv_reader import ReadStream, read_stream
from media.recorded_feed import START_NS, STEP_NS, coded, drawn_frames, moving_boxes
from programs.processes import eventually, free_ports
from rigs.examples import overlay

FRAMES, SIZE, KEYINT, TRACKS = 60, (320, 192), 20, 4
VIEW = View.fitted(SIZE, SIZE, fit="letterbox")
PLATFORM = Platform("uav-1", "00ff", VIEW)
_DELIMITER = 35


def pose_at(frame: int) -> Pose:
    """Northwards, 60 m above the ground, looking down."""
    return Pose(
        START_NS + frame * STEP_NS,
        47.0 + frame * 1e-6,
        8.5,
        height_m=60.0,
        camera=Orientation(0, -90, 0),
        hfov_deg=70.0,
    )


@pytest.fixture(scope="module")
def events() -> list[Event]:
    """Four seconds: pictures, tracks two frames later, a pose a second."""
    found: list[Event] = []
    waiting: list[Overlay] = []
    for frame, (data, keyframe) in enumerate(coded(drawn_frames(FRAMES, SIZE), kbps=300, keyint=KEYINT)):
        at_ns = START_NS + frame * STEP_NS
        if frame % 15 == 0:
            found.append(PoseUpdate(frame, at_ns, pose_at(frame), VIEW))
        found.append(VideoSample(frame, at_ns, data, keyframe))
        waiting.append(
            overlay(
                frame,
                moving_boxes(frame, TRACKS, SIZE),
                capture_ns=at_ns,
                track_ids=np.arange(1, TRACKS + 1) + frame,
                classes=("car", "van") * (TRACKS // 2),
            )
        )
        if len(waiting) > 2:
            found.append(waiting.pop(0))
    return found + waiting


def written(path: Path, events: list[Event]) -> ReadStream:
    stream = stream_file(path, platform=PLATFORM, fps=15)
    for event in events:
        stream.log(event)
    stream.close()
    stream.close()
    return read_stream(path)


def units(data: bytes) -> list[bytes]:
    """All but the access unit delimiter, which each picture of a transport stream has."""
    return [one for one in nal_units(data) if one[0] >> 1 != _DELIMITER]


def samples_of(events: list[Event]) -> list[VideoSample]:
    return [one for one in events if isinstance(one, VideoSample)]


def test_the_video_is_the_base_stream_unit_for_unit(events, tmp_path):
    """A picture that was coded again is worse, and costs a processor."""
    found = written(tmp_path / "flight.ts", events)
    assert [units(data) for _, data in found.video] == [units(one.data) for one in samples_of(events)]
    assert [at for at, _ in found.video] == [frame * 6_000 for frame in range(FRAMES)]


def test_each_frame_has_its_metadata_at_its_time(events, tmp_path):
    """Boxes would run ahead of the picture or lag behind it."""
    found = written(tmp_path / "flight.ts", events).klv
    assert [one.at for one in found] == [frame * 6_000 for frame in range(FRAMES)]
    for frame, one in enumerate(found):
        assert one.vmti is not None
        assert int.from_bytes(one.vmti[7]) == frame
        assert [target.track_id for target in one.targets] == list(range(frame + 1, frame + 1 + TRACKS))
        assert [target.class_name for target in one.targets] == ["car", "van", "car", "van"]
        assert one.items[2].timestamp() == pytest.approx((START_NS + frame * STEP_NS) / SECOND_NS, abs=1e-5)
        at = frame if frame > 12 else 0  # from one pose alone nobody knows where it goes
        assert one.items[13] == pytest.approx(47.0 + at * 1e-6, abs=1e-7), "the pose is that of the frame"


def test_ffprobe_shows_video_and_klv(events, tmp_path):
    """Other players would find one stream, or none."""
    if shutil.which("ffprobe") is None:
        pytest.skip("ffprobe is not installed")
    written(tmp_path / "flight.ts", events)
    words = ("-v", "error", "-count_packets", "-show_streams", "-show_programs", "-of", "json")
    answer = subprocess.run(
        ["ffprobe", *words, str(tmp_path / "flight.ts")], capture_output=True, text=True, check=True
    )
    assert answer.stderr.replace("Unsupported codec with id 98311 for input stream 1", "").strip() == ""
    said = json.loads(answer.stdout)
    video, klv = said["streams"]
    assert (video["codec_name"], video["width"], video["height"]) == ("hevc", *SIZE)
    assert (klv["codec_name"], klv["codec_tag_string"]) == ("klv", "KLVA")
    assert (video["nb_read_packets"], klv["nb_read_packets"]) == (str(FRAMES), str(FRAMES))
    assert said["programs"][0]["tags"]["service_name"] == "uav-1"


def test_it_begins_at_a_keyframe_and_goes_on_at_one_after_a_gap(events, tmp_path):
    """A player would show garbage, or nothing."""
    stream = stream_file(tmp_path / "flight.ts", platform=PLATFORM, fps=15)
    for event in events:
        if event.frame_index == 30 and isinstance(event, VideoSample):
            stream.skipped(5)
        if event.frame_index >= 5:
            stream.log(event)
    stream.close()
    found = read_stream(tmp_path / "flight.ts")
    shown = [*range(20, 30), *range(40, 60)]
    assert [at // 6_000 + 20 for at, _ in found.video] == shown
    decoder = BaseDecoder()
    assert all(decoder.decode(data) is not None for _, data in found.video)
    said = [int.from_bytes(one.vmti[7]) for one in found.klv if one.vmti]
    assert set(shown) <= {one.at // 6_000 + 20 for one in found.klv}
    assert said == sorted(said)
    assert said[0] == 20


def test_every_keyframe_has_its_parameter_sets(events, tmp_path):
    """Who tunes in later would see nothing for ever."""
    bare: list[Event] = []
    for event in events:
        if isinstance(event, VideoSample) and event.keyframe and event.frame_index:
            rest = [one for one in nal_units(event.data) if one[0] >> 1 not in (32, 33, 34)]
            bare.append(replace(event, data=b"".join(b"\0\0\0\1" + one for one in rest)))
        else:
            bare.append(event)
    found = written(tmp_path / "flight.ts", bare)
    keyframes = [data for at, data in found.video if at // 6_000 % KEYINT == 0]
    assert len(keyframes) == FRAMES // KEYINT
    assert all(parameter_sets(data) for data in keyframes)
    late = stream_file(tmp_path / "late.ts", platform=PLATFORM, fps=15)
    for event in bare:
        if event.frame_index:
            late.log(event)
    late.close()
    assert not (tmp_path / "late.ts").exists(), "without a parameter set nothing can be decoded"


def test_what_was_stored_does_not_go_back_in_time(events, tmp_path):
    """A player would jump."""
    stored = [
        replace(one, stored=True) if isinstance(one, VideoSample | Overlay) and one.frame_index < 20 else one
        for one in events
    ]
    found = written(tmp_path / "flight.ts", stored)
    assert len(found.video) == len(found.klv) == 40


def test_pictures_without_tracks_still_say_where_the_camera_was(events, tmp_path):
    """A detector that hangs would take the map along."""
    found = written(tmp_path / "flight.ts", [one for one in events if not isinstance(one, Overlay)])
    assert len(found.klv) == FRAMES
    assert all(one.vmti is None and 13 in one.items for one in found.klv)


def test_a_full_disk_is_one_sentence(events):
    """The ground would say nothing, or end."""
    failures = Failures(time.time_ns)
    sink = QueuedSink(
        "MPEG-TS", lambda: stream_file(Path("/dev/full"), platform=PLATFORM, fps=15), failures=failures
    )
    for event in events:
        sink.log(event)
    eventually(lambda: failures.now, what="the disk is full")
    assert "MPEG-TS file /dev/full cannot be written any further: No space left" in failures.now[0].reason
    assert sink.join(60)


def test_a_player_on_udp_has_it_live(events):
    """The very use of it: somebody watches."""
    # The player ends where nothing comes for so long: this machine may be busy.
    for patience_s in (2, 5, 20):
        found = live(events, patience_s)
        if len(found.video) >= FRAMES - 2 and len(found.klv) >= FRAMES - 4:
            break
    # A player that has not received the end does not know whether its last packets are whole.
    assert len(found.video) >= FRAMES - 2
    assert [units(data) for _, data in found.video[:-1]] == [
        units(one.data) for one in samples_of(events)[: len(found.video) - 1]
    ]
    assert len(found.klv) >= FRAMES - 4
    assert all(one.targets for one in found.klv)


def live(events, patience_s: int) -> ReadStream:
    """What a player on UDP has of them."""
    (port,) = free_ports(1)
    found: list[ReadStream] = []
    options = {"timeout": f"{patience_s}000000", "fifo_size": "100000"}
    player = threading.Thread(
        target=lambda: found.append(read_stream(f"udp://127.0.0.1:{port}", format="mpegts", options=options))
    )
    player.start()
    addresses = Addresses()
    stream = live_stream(Address(f"udp://127.0.0.1:{port}"), platform=PLATFORM, fps=15, addresses=addresses)
    eventually(lambda: _bound(port), what="the player listens")
    for event in events:
        stream.log(event)
        time.sleep(0.005)
    stream.close()
    player.join(60)
    assert len(found) == 1, "the player ended"
    with addresses.taken(Address(f"udp://127.0.0.1:{port}"), edge="uav-2"):
        pass  # it is free again
    return found[0]


def _bound(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return True
    return False


def test_a_second_edge_is_refused_until_the_first_has_ended():
    """Two streams at one port are none; and a name that resolves a minute later would stay refused."""
    addresses = Addresses()

    def opened(edge: str, host: str = f"127.0.0.1:{free_ports(1)[0]}") -> TransportStream:
        platform = replace(PLATFORM, edge=edge)
        return live_stream(Address(f"udp://{host}"), platform=platform, fps=15, addresses=addresses)

    first = opened("uav-1")
    with pytest.raises(UserError, match=r"taken by edge uav-1: put \{edge\} into it"):
        opened("uav-2")
    with pytest.raises(UserError, match="still taken by the session before"):
        opened("uav-1")
    first.close()
    opened("uav-2").close()
    for _ in range(2):
        with pytest.raises(UserError, match="has no host that can be found"):
            opened("uav-1", "nowhere.invalid:5600")


def test_metadata_is_carried_in_one_of_the_two_ways_of_the_standard(events, tmp_path):
    """Strict readers refuse stream type 0x06 with the stream id of the other way; others want the time."""
    path = tmp_path / "flight.ts"
    written(path, events)
    heads = set()
    data = path.read_bytes()
    for at in range(0, len(data), 188):
        packet = data[at : at + 188]
        pid, head = (packet[1] & 31) << 8 | packet[2], 4 + (1 + packet[4] if packet[3] & 32 else 0)
        if packet[1] & 64 and packet[head : head + 3] == b"\0\0\1":
            heads.add((pid, packet[head + 3], packet[head + 7] >> 7))
    assert heads == {(256, 0xE0, 1), (257, 0xBD, 1)}
    assert b"\x06\xe1\x01\xf0\x06\x05\x04KLVA" in data, "stream type 0x06, PID 257"
