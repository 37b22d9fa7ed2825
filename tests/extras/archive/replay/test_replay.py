"""``hvt-ground --log`` and ``replay``: a flight is received again, the same or with other models."""

import csv
import json
import threading
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import msgpack
import pytest

import hvt_ground.cli
from hvt_archive.reading.recorded import read_recordings
from hvt_archive.replay.command import messages_in, messages_of
from hvt_archive.replay.message_log import MessageLog, read_log
from hvt_common.protocol.channels import Channel, parse_key
from hvt_common.protocol.messages import (
    READ_VERSIONS,
    BaseHeader,
    Flags,
    Info,
    Message,
    PoseReport,
    RoiHeader,
    Status,
    TrackStep,
)
from hvt_common.transport.inbox import Received
from hvt_common.units import SECOND_NS
from hvt_ground.extras import Flight, Opening, Service
from rigs.drawn_flight import FRAMES

pytestmark = pytest.mark.integration

SETTINGS = ("--provider", "cpu", "--quiet")
RECORDED = Path(__file__).parent / "recorded" / "wire-4.hvtlog"
"""Of schema version 4; the README beside it says how it was made."""
NAMES = ("frame_index", "id", "x", "y", "w", "h", "class", "refined", "origin")


def replay(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    assert hvt_ground.cli.main(["replay", *map(str, words)]) == 0
    return capsys.readouterr().out


def lines(table: Path) -> list[tuple[str, ...]]:
    """What of it does not hang on the clock."""
    rows = csv.DictReader(table.read_text(encoding="utf-8").splitlines())
    return [tuple(row[name] for name in NAMES) for row in rows]


def test_the_same_models_see_the_same(drawn, tmp_path, capsys):
    """Whoever compares models would compare runs."""
    folder, summary = drawn.folder, drawn.ground
    new = ("--tracks", tmp_path / "again.csv", "--record", tmp_path)
    outcome = replay(capsys, folder / "flight.hvtlog", *new, *SETTINGS)
    assert (summary["frames"], summary["stills"]["received"] > 3) == (FRAMES, True)
    assert lines(tmp_path / "again.csv") == lines(folder / "flight.csv")
    assert f"stills    │ {summary['stills']['received']}," in outcome
    assert len(list(tmp_path.glob("hvt-uav-1-*.rrd"))) == 1


def test_another_detector_sees_something_else_at_the_speed_that_is_asked_for(drawn, tmp_path, capsys):
    """A flight would have to be flown again for each model, and a viewer see minutes in a moment."""
    times = [one.received_ns for one in read_log(drawn.folder / "flight.hvtlog")]
    speed = (times[-1] - times[0]) / SECOND_NS / 4
    words = ("--detector", "motion", "--classifier", "none", "--tracks", tmp_path / "motion.csv")
    began_s = time.monotonic()
    new = ("--record", tmp_path / "new", "--speed", speed)
    replay(capsys, drawn.folder / "flight.hvtlog", *words, *new, *SETTINGS)
    assert time.monotonic() - began_s > 3.5, "four seconds were asked for"
    base = [row for row in lines(tmp_path / "motion.csv") if row[-1] == "base"]
    assert base != [row for row in lines(drawn.folder / "flight.csv") if row[-1] == "base"]
    assert {row[6] for row in base} == {"moving"}
    assert len(list((tmp_path / "new").glob("*.rrd"))) == 1


def test_a_viewer_gets_the_last_events_before_it_ends(drawn, tmp_path, capsys, monkeypatch):
    """Each replay that was watched ended with a view that had FAILED."""
    gone, gone_first = threading.Event(), []

    class Viewing(Service):
        def sinks(self, flight: Flight) -> Iterable[Opening]:
            last_events = Mock(side_effect=lambda _hurry: gone_first.append(gone.wait(0.5)))
            yield Opening("live view", lambda: Mock(awaits_keyframe=False, close=last_events))

        def __exit__(self, *_: object) -> None:
            gone.set()

    monkeypatch.setattr("hvt_archive.replay.command.viewing", lambda _: Viewing())
    words = ("--detector", "motion", "--classifier", "none", "--record", tmp_path)
    replay(capsys, drawn.folder / "flight.hvtlog", *words, *SETTINGS)
    assert (gone_first, gone.is_set()) == ([False], True)


def test_what_came_again_in_flight_comes_again(drawn, tmp_path, capsys):
    """Live nobody asked for a keyframe: the replay would be dark up to the next that came by itself."""
    log, at = MessageLog(tmp_path / "lossy.hvtlog", most_bytes=10**9), 20
    messages = list(read_log(drawn.folder / "flight.hvtlog"))
    base = [one for one in messages if one.key.endswith(f"/{Channel.BASE}")]
    lost, behind = base[at : at + 2]
    header = BaseHeader.parse(lost.attachment, lost.payload)
    again = replace(header, flags=header.flags | Flags.RESENT).pack(lost.payload)
    at_ns = messages[0].received_ns  # 15 frames a second, however busy the machine was
    for one in messages:
        at_ns += SECOND_NS // 15 * one.key.endswith(f"/{Channel.BASE}")
        if one is not lost:
            log.log(replace(one, received_ns=at_ns))
        if one is behind:
            log.log(replace(lost, attachment=again, received_ns=at_ns + SECOND_NS // 30))
    log.close()
    words = ("--detector", "motion", "--classifier", "none", "--summary", tmp_path / "again.json", *SETTINGS)
    replay(capsys, tmp_path / "lossy.hvtlog", *words)
    summary = json.loads((tmp_path / "again.json").read_text(encoding="utf-8"))
    assert [summary[name] for name in ("frames_decoded", "lost", "resent")] == [FRAMES, 0, 1]


def test_a_recording_holds_video_and_stills(drawn, tmp_path, capsys):
    """Few log every message, and all have recordings: what was flown could not be read with a better model."""
    folder = drawn.folder
    recorded = read_recordings([folder / "flight.rrd"])
    logged = [item for item in read_log(folder / "flight.hvtlog") if parse_key(item.key)]
    again = list(messages_of(recorded))

    def of(messages, channel):
        return [one for one in messages if parse_key(one.key)[1] is channel]

    sent, read = ([one.payload for one in of(messages, Channel.BASE)] for messages in (logged, again))
    assert sent == read
    first, second = (
        {
            header.sequence: header
            for header in (RoiHeader.parse(one.attachment, one.payload) for one in of(messages, Channel.ROI))
        }
        for messages in (logged, again)
    )
    # A residual still is larger as a picture: some are left out, so that a recording stays as small as the flight.
    assert second.keys() <= first.keys()
    assert len(second) > len(first) / 4, (len(second), len(first))
    assert {one.codec for one in second.values()} == {"jpeg"}
    for number, found in second.items():
        was = first[number].named(recorded.info.class_names)
        shown = [
            (one.crop_source_px, one.box_source_px, one.frame_index, one.class_name) for one in (was, found)
        ]
        assert shown[0] == shown[1]
    new = ("--tracks", tmp_path / "again.csv", "--record", tmp_path)
    assert f"stills    │ {len(second)}," in replay(capsys, folder / "flight.rrd", *new, *SETTINGS)
    assert len({row[0] for row in lines(tmp_path / "again.csv")}) > 20
    assert any(row[7] == "1" for row in lines(tmp_path / "again.csv")), "a still spoke"


def test_what_cannot_be_is_said_in_one_sentence(drawn, tmp_path, capsys):
    """A traceback, or a ground that waits for ever."""
    files = {"log": drawn.folder / "flight.hvtlog", "flight": drawn.folder / "flight", "here": tmp_path}
    for words, said in (
        ("", "give the files first"),
        ("{flight}.csv", "is no message log"),
        ("{flight}.csv {flight}.rrd", "is no recording"),
        ("{here}/absent.hvtlog", "No such file"),
        ("{log} --listen tcp/127.0.0.1:1", "--listen is not accepted: a replay has no link"),
        ("{log} --cot udp://127.0.0.1:9", "--cot is not accepted: others would take what is replayed"),
        ("{log} --speed 0", "--speed 0 is not accepted"),
        ("{log} --detector {here}/absent.onnx", "absent.onnx"),
        ("{log} --edges UAV", "--edges 'UAV' is not usable"),
        (
            "{log} --edges nobody --detector motion --classifier none",
            "flight.hvtlog has no session that can be shown, of an edge that --edges nobody names",
        ),
        ("{log} --tracks {here}/absent/t.csv", "--tracks"),
    ):
        # A folder may be of a disk that is mounted later: 2 is what can never work.
        given = ["replay", *words.format(**files).split()]
        assert hvt_ground.cli.main(given) == (1 if "--tracks" in words else 2), words
        error = capsys.readouterr().err
        assert said in error
        assert len(error.splitlines()) == 1, error


def parsed(item: Received) -> object:
    _, channel = parse_key(item.key) or ("", None)
    match channel:
        case Channel.BASE:
            return BaseHeader.parse(item.attachment, item.payload, versions=READ_VERSIONS)
        case Channel.ROI:
            return RoiHeader.parse(item.attachment, item.payload, versions=READ_VERSIONS)
    kinds: dict[Channel | None, type[Message]] = {
        Channel.TRACKS: TrackStep,
        Channel.POSE: PoseReport,
        Channel.STATUS: Status,
        Channel.INFO: Info,
    }
    return kinds[channel].parse(item.payload, versions=READ_VERSIONS)


def test_the_halves_of_a_log_are_played_in_their_order(drawn, tmp_path):
    """Both begin with what an edge said of itself long ago: the flight would begin in its middle."""
    folder = drawn.folder
    log = MessageLog(tmp_path / "flight.hvtlog", most_bytes=250_000)
    whole = []
    for item in read_log(folder / "flight.hvtlog"):
        log.log(item)
        if not item.key.endswith("/info"):
            whole.append(item.received_ns)
    log.close()
    assert log.before.is_file()
    times = [
        item.received_ns for item in messages_in([log.path, log.before])() if not item.key.endswith("/info")
    ]
    assert len(times) > 20
    assert times == whole[-len(times) :], "two that come at once may be logged the other way round"


def test_every_message_of_version_4_is_read():
    """Recordings, and what an edge has stored on its disk, would be lost by an update."""
    items = list(read_log(RECORDED))
    assert {msgpack.unpackb(item.attachment or item.payload)[0] for item in items} == {4}
    kinds = {type(parsed(item)).__name__ for item in items}
    assert kinds == {"BaseHeader", "RoiHeader", "TrackStep", "PoseReport", "Status", "Info"}


def test_a_flight_of_version_4_is_received(tmp_path, capsys):
    """The log of last year's flight would show nothing with this year's detector."""
    words = ("--detector", "motion", "--classifier", "none", "--summary", tmp_path / "summary.json")
    replay(capsys, RECORDED, *words, "--record", tmp_path, *SETTINGS)
    sessions = {one["edge"]: one for one in json.loads((tmp_path / "summary.json").read_text())}
    assert {edge: one["frames"] for edge, one in sessions.items()} == {"uav-2": 59, "edge-1": 28}
    assert sessions["uav-2"]["stills"]["received"] == 34
    assert "undecodable" not in sessions["uav-2"]["stills"]["reasons"]["outcomes"]
    assert sessions["edge-1"]["unusable_messages"] == 0
    assert sessions["edge-1"]["stills"]["received"] == 7
