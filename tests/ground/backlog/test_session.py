"""A hole in a flight is filled: real access units and stills that were kept, into real recordings, read back."""

import csv
import itertools
import threading
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import av
import numpy as np
import pytest

from hvt_archive.exports.tables import SessionTiming, timing_table
from hvt_common.inference.view_trust import ViewTrust
from hvt_common.protocol.ledger import Account
from hvt_common.protocol.messages import (
    AcknowledgedRange,
    BacklogUnit,
    Feedback,
    Info,
    RoiHeader,
    pack_backlog_units,
)
from hvt_common.runtime.failures import Failures
from hvt_common.transport.inbox import Received
from hvt_common.values import Posterior
from hvt_common.video.hevc import BaseDecoder
from hvt_ground.backlog.edge_backlog import BacklogRecording, BacklogRecordings
from hvt_ground.backlog.session_backlog import LateStills
from hvt_ground.perception.pipeline import DecodedFrame
from hvt_ground.perception.session import FIRST_TRACK_ID
from hvt_ground.perception.stills.decode import ReceivedStill
from hvt_ground.perception.stills.refine import ViewTilt
from hvt_ground.report.status import completed, summary, table
from hvt_ground.session.edge_sessions import join
from hvt_ground.sinks import Outputs, QueuedSink, Sink
from hvt_ground.sinks.rerun.recorder import Recorder, RecorderSettings
from hvt_ground.sinks.rerun.still_places import SLOTS
from programs.processes import eventually
from programs.rrd import Recording
from rigs.backlog_chunks import chunks, info_object, still_object, video_object
from rigs.examples import overlay, seen
from rigs.flight import (
    CLASSES,
    Flight,
    RedSquares,
    SameAnswer,
    StoredPerception,
    line_bytes,
    patient_worker,
    pipeline_of,
    square_box,
)
from rigs.handled import ReceiverRig

FIRST_STORED = 2**31
PICTURE = DecodedFrame(0, 0, 0, np.zeros((8, 8, 3), np.uint8))


def acknowledged(session_id: int, kind: str, number: int, count: int) -> AcknowledgedRange:
    return AcknowledgedRange(session_id=session_id, kind=kind, number=number, acknowledged_bytes=count)


class Rig(ReceiverRig):
    """Sessions and former sessions with recordings in a folder."""

    def __init__(
        self, folder: Path, flight: Flight, *, detector_of=RedSquares, timing=None, most_files=32, **rest
    ) -> None:
        self.folder = self.backlog_folder = folder
        self._detector_of, self._timing = detector_of, timing
        self._recorder = {"compact_bytes": rest.pop("compact_bytes")} if "compact_bytes" in rest else {}
        self.failures = Failures(time.time_ns)
        self.outputs = Outputs(self.failures)
        self._backlog_numbers = itertools.count()
        self.live: list[Received] = []
        self.recordings = BacklogRecordings(self._open_backlog, most_files=most_files, open_s=20)
        super().__init__(flight, recordings=self.recordings, **rest)

    def sinks_of(self, info: Info) -> list[Sink]:
        sinks: list[Sink] = [self._sink(info, self.folder / f"{len(self.opened)}.rrd")]
        if self._timing is not None:
            sinks.append(SessionTiming(self._timing, edge=info.edge, session_id=info.session_id))
        return sinks

    def backlog_perception(self, info: Info) -> StoredPerception:
        return StoredPerception(info, detector_of=self._detector_of)

    def _open_backlog(self, info: Info) -> BacklogRecording:
        path = self.backlog_folder / f"backlog-{next(self._backlog_numbers)}.rrd"
        return BacklogRecording(info, sink=self._sink(info, path), perception=StoredPerception(info))

    def _sink(self, info: Info, path: Path) -> QueuedSink:
        made = RecorderSettings.of(info, path, **self._recorder)
        return self.outputs.open("recording", lambda: Recorder(made))

    def put(self, *items: Received) -> None:
        """What Zenoh's callback does, and then all of it is handled and seen."""
        self.live += items
        super().put(*items)
        self.wait_for(lambda: self.inbox.handled)
        # The receiving thread hands boxes on to perception.
        self.wait_for(lambda: self.receiver.backlog.working == 0)
        self.settle()
        self.wait_for(lambda: self.outputs.idle)

    def base(self, *indices: int) -> None:
        self.put(*(self.flight.base(index) for index in indices))

    def stored(self, kind: str, number: int, data: bytes, *, of: Flight | None = None, **cut):
        """An object of a flight comes in chunks; what it is acknowledged with."""
        session_id = (of or self.flight).session_id
        self.put(*chunks(session_id, kind, number, data, **cut))
        return acknowledged(session_id, kind, number, len(data))

    def video(self, first: int, end: int, *, of: Flight | None = None):
        return self.stored("base", first, video_object(of or self.flight, range(first, end)), of=of)

    def still(self, frame: int, number: int, *, of: Flight | None = None, chunk_bytes=1400, **changes):
        data = still_object(of or self.flight, frame, number, **changes)
        return self.stored("still", number, data, of=of, chunk_bytes=chunk_bytes)

    def facts(self, of: Flight) -> None:
        self.stored("info", 0, info_object(of), of=of)

    def bring(self, items: list[Received]) -> None:
        for item in items:
            self.inbox.put(item)

    def acknowledged_ranges(self) -> list[AcknowledgedRange]:
        self.reported()
        return [acknowledged_range for report in self.port.reports for acknowledged_range in report.backlog]

    def reported(self) -> Feedback:
        """A report that speaks of all that was put."""
        self.wait_for(lambda: self.inbox.handled)
        before = len(self.port.reports)
        self.wait_for(lambda: len(self.port.reports) >= before + 2)  # one may have been under way
        return self.port.reports[-1]

    def __exit__(self, kind, *rest) -> None:
        super().__exit__(kind, *rest)
        self.outputs.close(within_s=60)
        assert all(one.working for one in self.failures.parts)


@pytest.fixture(scope="module")
def flight() -> Flight:
    """Six seconds; the link was away from frame 25 to 64."""
    return Flight(90, keyframes=(40, 65))


def decoded(recording: Recording) -> int:
    """How many pictures a player makes of the video."""
    decoder = av.CodecContext.create("hevc", "r")
    decoder.thread_type = "SLICE"
    return sum(len(decoder.decode(av.Packet(data))) for _, _, data in recording.video())


def test_the_hole_of_an_outage_is_filled(flight, tmp_path):
    """After the outage nobody could see what happened in it."""
    with Rig(tmp_path, flight) as rig:
        rig.base(*range(25))
        for index in range(65, 75):
            rig.base(index)
        perceived, backlog = rig.session.perceived, rig.session.backlog.totals
        before = perceived.tracks, perceived.detections_run
        # It begins in mid-GOP, with some that came, as an edge hands over what was not acknowledged.
        assert {rig.video(40, 65), rig.video(22, 40)} <= set(rig.acknowledged_ranges())
        assert (perceived.tracks, perceived.detections_run) == before
        assert rig.session.reception.analyzed[0] == 74
        for index in range(75, 80):  # one by one: a burst would leave out detections
            rig.base(index)
        assert perceived.tracks == before[0], "the tracker of now went on undisturbed"
        # What leads up to them is no frame of the outage.
        assert (backlog.frames, backlog.left_out, rig.session.frames_decoded) == (40, 0, 40)
    recording = Recording(tmp_path / "0.rrd")
    assert recording.video() == [(u.frame_index, u.capture_ns, u.data) for u in flight.units[:80]]
    assert decoded(recording) == 80
    texts = [text for _, _, text in recording.events()]
    assert any(text.startswith("3 s of video from the outage at ") for text in texts)
    content = summary(rig.ended[0])
    assert content["backlog"]["frames"] == 40
    assert "s of video came afterwards" in dict(table(content))["outages"]


def test_boxes_stand_in_the_hole_and_end_with_it(flight, tmp_path):
    """Boxes of the outage would stand over the picture of now, or those from before it over the outage."""
    with Rig(tmp_path, flight) as rig:
        rig.base(*range(25))
        rig.base(*range(65, 75))
        before = Recording(tmp_path / "0.rrd")
        rig.video(40, 60)
        rig.video(25, 40)
        assert rig.session.backlog.totals.left_out == 0, "what leads up to a stretch is none of it"
        rig.base(*range(75, 90))
    after = Recording(tmp_path / "0.rrd")
    for frame in (3, 20, 24, 65, 66, 74):
        assert after.boxes(frame) == before.boxes(frame), frame
    assert not set(after.boxes(85)) & set(range(FIRST_TRACK_ID, FIRST_TRACK_ID + 10))
    for frame in (30, 37, 45, 58):
        ((track_id, box),) = after.boxes(frame).items()
        assert track_id >= FIRST_TRACK_ID
        assert abs(box.box_px[0] - square_box(frame)[0]) < 12, "the boxes of that frame"
        assert box.class_after == CLASSES[0]
    # Nothing is known of the frames after.
    assert [len(after.boxes(frame)) for frame in (61, 64, 74)] == [0, 0, 1]


def looked_at(flight, each=lambda late: None, *, then=lambda perception: None, **parts):
    """Six pictures of stored video; ``each`` is told whether half of them have passed."""
    found, decoder = [], BaseDecoder()
    perception = StoredPerception(flight.info(), **parts)
    then(perception)
    analyze = perception.track(found.append)
    for unit in flight.units[:6]:
        each(unit.frame_index >= 3)
        analyze(unit.frame_index, unit.capture_ns, decoder.decode(unit.data))
    return found[1:]


def test_stored_video_of_an_unknown_view_is_doubted_as_it_is_live(flight):
    """Boxes that were dashed and unnamed before an outage were certain in the middle of it."""
    trust, taken = ViewTrust(None, hence=""), []
    trust.take = lambda seen: taken.append(len(seen))
    found = looked_at(flight, lambda late: setattr(trust, "unlike", late), trust=trust)
    assert [one.doubted.tolist() for one in found] == [[False]] * 2 + [[True]] * 3
    assert taken == [1, 1], "it is told by what is found"


def test_a_bus_of_stored_video_is_called_as_it_is_live(flight):
    """Seen aslant it was a vehicle before the outage and after it, and a bus in the middle."""

    class Buses(RedSquares):
        class_names, confidence = ("bus",), 0.95

    tilt = ViewTilt(vague_kinds=True)
    found = looked_at(flight, lambda late: setattr(tilt, "aslant", late), detector_of=Buses, tilt=tilt)
    assert [one.words for one in found] == [("bus",)] * 2 + [("vehicle",)] * 3


def test_stored_video_tells_the_tilt_of_its_view(flight):
    """Of a session that is over nothing else does."""
    taken = []

    def take(tracks, _names, *, height_px):
        taken.append((len(tracks), height_px))

    looked_at(flight, then=lambda perception: setattr(perception.tilt, "take", take))
    assert taken == [(1, 192)] * 2


@pytest.mark.parametrize("compact_bytes", [6_000, 1 << 30])
def test_a_filled_hole_survives_folding_and_the_footer(flight, tmp_path, compact_bytes):
    """Rows that come late would be lost or doubled where the append log is compacted, or when the file is closed."""
    with Rig(tmp_path, flight, compact_bytes=compact_bytes) as rig:
        rig.base(*range(25))
        rig.base(*range(65, 90))
        rig.video(40, 65)
        rig.still(50, 0)
        rig.video(24, 40)
    recording = Recording(tmp_path / "0.rrd")
    assert recording.video() == [(u.frame_index, u.capture_ns, u.data) for u in flight.units]
    assert decoded(recording) == 90
    assert [frame for frame, _ in recording.stills()] == [50]
    assert len(recording.boxes(45)) == 1


def test_stills_of_an_outage_are_shown_at_their_own_time(flight, tmp_path):
    """They would be shown as of now, or refine a track that is another object."""
    with Rig(tmp_path, flight) as rig:
        rig.base(*range(25))
        rig.put(flight.still(10, 0))
        rig.base(*range(65, 90))
        refined = rig.session.perceived.refined
        order = (5, 1, 12, 2, 3, 4, 6, 7, 8, 9, 10, 11, 5)  # the acknowledgement of the first was lost
        kept = {rig.still(26 + sequence, sequence, chunk_bytes=300) for sequence in order}
        assert kept <= set(rig.acknowledged_ranges())
        results = [one.still_sequence for report in rig.port.reports for one in report.stills]
        assert sorted(results) == list(range(13)), "the edge hears of each once"
        assert rig.session.perceived.refined == refined
        assert rig.session.perceived.outcomes["frame lost"] == 12
    recording = Recording(tmp_path / "0.rrd")
    assert [frame for frame, _ in recording.stills() if 25 < frame < 65] == list(range(27, 39))
    captions = [recording.latest(f"/stills/{slot}", "Boxes2D:labels", 33) for slot in range(SLOTS)]
    assert sum(bool(text) for text in captions) >= 5
    assert any("12 stills from the outage at " in text for _, _, text in recording.events())


def test_a_still_on_both_ways_is_shown_once(flight, tmp_path):
    """The gallery would show it twice, and the account of one side would lack a message."""
    with Rig(tmp_path, flight) as rig:
        rig.base(*range(25))
        rig.put(flight.still(10, 0), flight.still(12, 2))
        rig.still(11, 1)
        rig.still(10, 0)
        rig.put(flight.still(11, 1))
        assert (rig.session.reception.stills, rig.session.backlog.totals.stills) == (2, 1)
        assert rig.session.reception.ledger.messages(Account.ROI) == 3
        assert rig.reported().missing_stills == ()
    texts = [text for _, _, text in Recording(tmp_path / "0.rrd").events() if text.startswith("still #")]
    assert sorted(text[:8] for text in texts) == ["still #0", "still #1", "still #2"]


@pytest.mark.parametrize("own", [True, False], ids=["open session", "former session"])
def test_stills_of_an_outage_name_the_tracks_of_its_video(flight, tmp_path, own):
    """They "matched no track", although the boxes of the outage stand beside them in the recording."""
    stored = flight if own else Flight(80, keyframes=(40,))
    with Rig(tmp_path, flight) as rig:
        rig.base(*range(25))
        if own:
            rig.base(*range(65, 75))
        rig.facts(stored)
        rig.still(45, FIRST_STORED + 3, of=stored)
        rig.video(40, 60, of=stored)
    recording = Recording(tmp_path / ("0.rrd" if own else "backlog-0.rrd"))
    texts = [(frame, text) for frame, _, text in recording.events() if "late still #3" in text]
    assert [frame for frame, _ in texts] == [45, 45]
    assert "late still #3 of edge track 1: car, by itself bus .90" in texts[0][1]
    assert f"late still #3 → track {FIRST_TRACK_ID}: car → bus .90" in texts[1][1]
    before, after = (recording.boxes(frame)[FIRST_TRACK_ID] for frame in (43, 50))
    assert (before.class_after, before.refined) == ("car", False)
    assert (after.class_after, after.refined, after.label) == ("bus", True, f"{FIRST_TRACK_ID} bus")


def named(tilt, confidence, shown, *, aslant=False, **changes):
    """A still of a bus, and a list of that frame after it."""
    late = LateStills(tilt, scale=1.0)
    bus = Posterior("bus", confidence, 0.3, np.array([1 - confidence, confidence], np.float32))
    still = seen(0, 5, bus, (0.0, 0.0, 20.0, 20.0), edge=1).event
    late.take(replace(still, stored=True, **changes))
    tilt.aslant = aslant
    return late.named(shown)


@pytest.mark.parametrize(
    ("confidence", "guess", "word"), [(0.95, True, "bus"), (0.7, True, "something"), (0.7, False, "bus")]
)
def test_a_still_names_its_own_track_and_no_guess_beside_it(confidence, guess, word):
    """One named car made every guess around it as firm as itself, and one that came before its track doubted that."""
    doubted = np.array([guess, True, False])
    boxes = [(0, 0, 20, 20), (50, 50, 60, 60), (80, 80, 90, 90)]
    shown = overlay(5, boxes, stored=True, doubted=doubted)
    still, shown = named(ViewTilt(), confidence, shown, doubted=confidence < 0.9)
    assert shown.words == (word, "something", "car")
    assert still.doubted == (word == "something")


@pytest.mark.parametrize(("confidence", "word"), [(0.7, "vehicle"), (0.95, "bus")])
def test_a_still_of_an_outage_is_called_as_the_box_that_it_names(confidence, word):
    """Seen aslant the live picture said vehicle, and what came of the same view afterwards a kind of it."""
    tilt = ViewTilt(vague_kinds=True)
    still, shown = named(tilt, confidence, overlay(5, [(0, 0, 20, 20)], stored=True), aslant=True)
    assert (still.words, shown.words, shown.classes) == (("car", word), (word,), ("bus",))


def received(item: Received) -> ReceivedStill:
    return ReceivedStill(RoiHeader.parse(item.attachment, item.payload), item.payload)


def test_a_still_of_a_session_that_is_over_is_doubted_as_it_is_live(flight):
    """Without a track, and not sure, it was a bus in the list of stills."""
    found = []
    StoredPerception(flight.info(), tilt=ViewTilt()).read(received(flight.still(3, 0)), emit=found.append)
    assert [(one.class_after, one.doubted) for one in found] == [("bus", True)]


def test_a_still_at_a_frame_that_is_known_speaks_on_its_track(flight, tmp_path):
    """A still that a short outage held up would be lost on its track."""
    with Rig(tmp_path, flight) as rig:
        for index in range(25):  # one by one: a worker that is behind leaves detection out
            rig.base(index)
        rig.still(15, 0)
        assert rig.session.perceived.outcomes["matched"] == 1
        assert rig.session.perceived.refined == 1


def test_a_still_of_an_edge_track_that_is_known_now_speaks_on_it(flight, tmp_path):
    """What the edge saw of a lorry a minute ago would not be known of the lorry that is still there."""
    with Rig(tmp_path, flight) as rig:
        rig.base(*range(10))
        rig.base(*range(65, 70))
        rig.put(flight.step(69, {31: square_box(69)}))
        rig.base(*range(70, 80))
        rig.still(30, 0, track_id=31)
        rig.still(31, 1, track_id=32)
        outcomes = rig.session.perceived.outcomes
        assert (outcomes["matched"], outcomes["frame lost"] + outcomes["late"]) == (1, 1)


def test_pieces_are_in_the_account_to_the_byte(flight, tmp_path):
    """The two sides' accounts would differ, and the end would be waited for."""
    other = Flight(3)
    with Rig(tmp_path, flight) as rig:
        rig.base(*range(10))
        kept = chunks(flight.session_id, "still", 3, still_object(flight, 4, 3), chunk_bytes=200)
        rig.put(*kept, *kept[:2])
        rig.still(1, 0, of=other)
        ledger = rig.session.reception.ledger
        assert (ledger.messages(Account.BACKLOG), ledger.line_bytes) == (len(kept) + 3, line_bytes(rig.live))
        pressed = sum(len(one.payload) for one in rig.live if one.key.endswith("/backlog"))
        assert ledger.summary(1.0).backlog_bytes == pressed


def test_what_a_former_session_kept_has_a_recording_of_its_own(flight, tmp_path):
    """What an edge saw before it was started again would be lost, or stand in another flight's recording."""
    former = Flight(45, keyframes=(20,))
    sid = former.session_id
    with Rig(tmp_path, flight) as rig:
        rig.base(*range(20))
        whole = rig.still(7, 3, of=former, chunk_bytes=200)
        requested = rig.acknowledged_ranges()
        assert acknowledged(sid, "info", 0, 0) in requested
        assert whole not in requested
        assert list(tmp_path.glob("backlog-*")) == []
        rig.facts(former)
        rig.still(7, 3, of=former, chunk_bytes=200)
        video = rig.video(20, 45, of=former)
        rig.still(7, 3, of=former)
        said = set(rig.acknowledged_ranges())
        assert {whole, video} <= said
        assert any(one.kind == "info" and one.acknowledged_bytes for one in said)
        assert rig.session.backlog.totals.stills == 0
    first, recording = Recording(tmp_path / "0.rrd"), Recording(tmp_path / "backlog-0.rrd")
    assert [frame for frame, _, _ in first.video()] == list(range(20))
    assert [frame for frame, _, _ in recording.video()] == list(range(20, 45))
    assert decoded(recording) == 25
    assert [frame for frame, _ in recording.stills()] == [7]
    assert len(recording.boxes(30)) == 1
    texts = [text for _, _, text in recording.events()]
    assert "1 still and 2 s of video of this session arrived after it had ended" in texts
    data = (tmp_path / "backlog-0.rrd").read_bytes()
    assert f"uav-1-{sid:08x}".encode() in data, "the same recording to Rerun"
    content = completed(summary(rig.ended[0]), rig.receiver)
    assert content["backlog"]["recordings"] == [str(tmp_path / "backlog-0.rrd")]


def test_no_more_files_are_made_than_the_bound(flight, tmp_path):
    """Whoever makes up former sessions would fill the disk, and the edge would forget what nobody wrote down."""
    formers = [Flight(2) for _ in range(3)]
    with Rig(tmp_path, flight, most_files=2) as rig:
        rig.base(*range(5))
        for former in formers:
            rig.facts(former)
            rig.still(1, 0, of=former)
        said = {one.session_id for one in rig.acknowledged_ranges()}
        assert said == {former.session_id for former in formers[:2]}, "of the third nothing is taken"
        assert rig.receiver.receiver.unusable >= 2
        rig.still(0, 1, of=formers[0])
    assert len(list(tmp_path.glob("backlog-*"))) == 2
    assert len(Recording(tmp_path / "backlog-0.rrd").stills()) == 2, "what is open goes on"


def test_a_recording_in_use_stays_open(flight, tmp_path):
    """What goes into a file that was pushed out is lost without a word."""
    formers, made = [Flight(2) for _ in range(4)], []
    outputs = Outputs(Failures(time.time_ns))

    def open_one(info: Info) -> BacklogRecording:
        path = tmp_path / f"{len(made)}.rrd"
        sink = outputs.open("recording", lambda: Recorder(RecorderSettings.of(info, path)))
        made.append(BacklogRecording(info, sink=sink, perception=StoredPerception(info)))
        return made[-1]

    recordings = BacklogRecordings(open_one, most=2, open_s=20)
    with recordings.using(formers[0].info()) as first:
        for former in formers[1:]:
            with recordings.using(former.info()) as other:
                assert other is made[-1].backlog
        assert recordings.open_sessions == [formers[0].session_id, formers[3].session_id]
        first.read_still(received(formers[0].still(1, 1)))
    with recordings.using(flight.info()) as other:
        assert other is made[4].backlog
    assert recordings.open_sessions == [formers[3].session_id, flight.session_id], "done with, it may go"
    recordings.close()
    with recordings.using(flight.info()) as other:
        assert other is None
    few = BacklogRecordings(open_one, most_files=1, open_s=20)
    with few.using(formers[0].info()) as first, few.using(formers[1].info()) as other:
        assert first is made[5].backlog
        assert other is None, "so many came at once that the last could not be refused before"
    few.close()
    outputs.close(within_s=60)
    texts = [text for _, _, text in Recording(tmp_path / "0.rrd").events()]
    assert "1 still of this session arrived after it had ended" in texts


def test_damaged_and_foreign_pieces_are_counted_and_skipped(flight, tmp_path):
    """One bad chunk would end the ground."""
    with Rig(tmp_path, flight) as rig:
        rig.still(1, 0)  # no session is open yet
        assert rig.receiver.receiver.unusable == 1
        rig.base(*range(5))
        item = chunks(flight.session_id, "still", 0, still_object(flight, 1, 0))[0]
        rig.put(replace(item, payload=item.payload[:-1]), replace(item, attachment=b"\x93\x02"))
        rig.stored("still", 9, still_object(flight, 1, 0))
        rig.stored("base", 2, b"no video")
        assert rig.receiver.receiver.unusable == 5
        assert {one.acknowledged_bytes for one in rig.acknowledged_ranges()} == {0}
        totals = rig.session.backlog.totals
        for first, end, broken in ((65, 70, flight.units[66].data), (2, 5, flight.units[3].data)):
            whole = video_object(flight, range(first, end))
            rig.stored("base", first, whole.replace(broken, bytes(len(broken))))
            assert rig.receiver.error is None
            # What follows a broken frame is no picture; the second came at once, and is shown.
            assert (totals.frames, totals.left_out) == (1, 4)


@pytest.mark.parametrize("own", [True, False])
def test_the_last_moment_there_is_can_be_shown(flight, tmp_path, own):
    """One message with a time at the end of all times, as valid as any, would end the ground."""
    last_ns, last = 2**63 - 1, 2**32 - 1
    sender = flight if own else Flight(45, keyframes=(40,))
    units = [
        BacklogUnit(last - 1, last_ns - 1, keyframe=True, data=sender.units[40].data),
        BacklogUnit(last, last_ns, keyframe=False, data=sender.units[41].data),
    ]
    latest = {"frame_index": last, "capture_ns": last_ns, "send_delay_ns": last_ns}
    with Rig(tmp_path, flight) as rig:
        rig.base(*range(25))
        if not own:
            rig.facts(sender)
        rig.stored("base", last - 1, pack_backlog_units(units), of=sender)
        for sequence, changes in ((last, latest), (3, {"capture_ns": 0, "send_delay_ns": -last_ns})):
            rig.still(12, sequence, of=sender, **changes)
        rig.base(*range(65, 75))
        assert rig.receiver.error is None
        assert rig.session.frames_decoded == 35
    recording = Recording(tmp_path / ("0.rrd" if own else "backlog-0.rrd"))
    timed = [(frame, at_ns) for frame, at_ns, _ in recording.video()]
    assert timed[-2:] == [(last - 1, last_ns - 1), (last, last_ns)]
    assert len(recording.stills()) == 2


class Busy(SameAnswer):
    """Reads nothing before it ``may_read``."""

    def __init__(self) -> None:
        super().__init__()
        self.may_read = threading.Event()

    def read(self, stills, base_bgr):
        self.may_read.wait(60)
        return super().read(stills, base_bgr)


def test_a_still_is_acknowledged_when_it_was_read_and_not_before(flight, tmp_path):
    """The edge forgets what is acknowledged: on a busy ground that is closed, the still would be nowhere."""
    still, busy = still_object(flight, 15, 4), Busy()
    with Rig(tmp_path, flight, pipeline=lambda emit: pipeline_of(emit, reader=busy)) as rig:
        rig.base(*range(25))
        rig.bring(chunks(flight.session_id, "still", 4, still))
        for _ in range(3):  # two seconds, in which its last byte is sent again
            rig.bring(chunks(flight.session_id, "still", 4, still, chunk_bytes=len(still) - 1)[-1:])
            assert {one.acknowledged_bytes for one in rig.acknowledged_ranges()} == {len(still) - 1}
        assert rig.session.backlog.totals.stills == 0
        busy.may_read.set()
        eventually(lambda: rig.receiver.backlog.working == 0)
        assert rig.acknowledged_ranges()[-1] == acknowledged(flight.session_id, "still", 4, len(still))
        assert rig.session.backlog.totals.stills == 1
    assert [frame for frame, _ in Recording(tmp_path / "0.rrd").stills()] == [15]


def test_what_a_session_left_unread_comes_again_and_is_shown(flight, tmp_path):
    """It would be told as seen twice, or be seen never."""
    busy, hasty = Busy(), partial(patient_worker, finish_s=0.2, leave_s=0.2)
    pipeline = lambda emit: pipeline_of(emit, reader=busy)  # noqa: E731
    with Rig(tmp_path, flight, pipeline=pipeline, worker_of=hasty) as rig:
        rig.base(*range(25))
        for number in (3, 4):
            rig.bring(chunks(flight.session_id, "still", number, still_object(flight, 11 + number, number)))
        eventually(lambda: rig.receiver.backlog.working == 2)
        rig.inbox.put(flight.status(base=25, state="ended"))
        eventually(lambda: rig.ended and not rig.receiver.backlog.working)
        reported = [one for report in rig.port.reports for one in report.backlog]
        busy.may_read.set()
        rig.port.flight = rig.flight = Flight(10)
        rig.base(*range(10))
        assert acknowledged(flight.session_id, "still", 4, 0) in rig.acknowledged_ranges()
        whole = rig.still(15, 4, of=flight)
        assert whole not in reported
        assert whole in rig.acknowledged_ranges()
    assert [frame for frame, _ in Recording(tmp_path / "backlog-0.rrd").stills()] == [15]


def test_a_still_of_which_a_part_came_is_missed_until_it_is_whole(flight, tmp_path):
    """The edge would not send it again on the quick way, and the rest might never come on the slow one."""
    with Rig(tmp_path, flight) as rig:
        rig.base(*range(25))
        rig.put(flight.still(10, 0), flight.still(12, 2))
        first, *others = chunks(flight.session_id, "still", 1, still_object(flight, 11, 1), chunk_bytes=300)
        rig.put(first)
        assert rig.reported().missing_stills == (1,)
        rig.put(*others)
        assert rig.reported().missing_stills == ()


def test_timing_says_of_pieces_what_became_of_them(flight, tmp_path):
    """An object that was refused would count as shown, at once."""
    times = tmp_path / "t.csv"
    lines = QueuedSink("timing table", lambda: timing_table(times), failures=Failures(time.time_ns))
    with Rig(tmp_path, flight, timing=lines) as rig:
        rig.base(*range(5))
        for number, data in (
            (0, still_object(flight, 2, 0)),
            (9, still_object(flight, 3, 1)),
        ):  # another inside
            rig.stored("still", number, data, chunk_bytes=len(data) // 2 + 1)
    assert lines.join(60)
    with times.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["kind"] == "backlog-still"]
    shown = [(row["sequence"], int(row["shown_ns"]) > 0) for row in rows]
    assert shown == [("0", False), ("0", True), ("9", False), ("9", False)]


def test_a_still_is_read_in_the_middle_of_a_stretch(flight, tmp_path):
    """Boxes of a stretch take a slow ground half a minute, and the still would wait for them all."""
    order, steps = [], threading.Semaphore(0)

    class Stepwise(RedSquares):
        def detect(self, image_bgr):
            order.append("boxes")
            assert steps.acquire(timeout=60)
            return super().detect(image_bgr)

    class Reader(SameAnswer):
        def read(self, stills, base_bgr):
            order.append("still")
            return super().read(stills, base_bgr)

    pipeline = lambda emit: pipeline_of(emit, reader=Reader())  # noqa: E731
    with Rig(tmp_path, flight, pipeline=pipeline, detector_of=Stepwise) as rig:
        rig.base(*range(25))
        rig.bring(chunks(flight.session_id, "base", 40, video_object(flight, range(40, 60))))
        eventually(lambda: order and rig.receiver.backlog.working == 0)
        rig.bring(chunks(flight.session_id, "still", 4, still_object(flight, 45, 4)))
        eventually(lambda: rig.receiver.backlog.working == 1)
        steps.release()
        eventually(lambda: "still" in order)
        assert order[:2] == ["boxes", "still"]
        steps.release(1000)
        eventually(lambda: rig.session.idle)
        assert order.count("boxes") == 7


def test_stills_do_not_wait_for_boxes_in_stored_video():
    """Boxes of a stretch take a slow ground half a minute: for so long no still of the outage would be read."""
    order, closed, read = [], [], threading.Event()

    def boxes():
        try:
            for _ in range(400):
                if read.is_set():
                    break
                order.append("boxes")
                time.sleep(0.01)
                yield
            order.append("boxes ended")
            while True:
                yield
        finally:
            closed.append(1)

    def still():
        order.append("still")
        read.set()
        yield

    worker = patient_worker(lambda *_: None, lambda *_: None, lambda _stills: None, finish_s=0.1)
    try:
        assert worker.submit(boxes(), last=True)
        eventually(lambda: order)
        assert worker.submit(still())
        eventually(lambda: "boxes ended" in order)
        assert order.index("still") < order.index("boxes ended")
        assert order[0] == "boxes", "it was in the middle of one"
        taken = [worker.submit(boxes(), last=True) for _ in range(9)]
        assert (taken.count(True), taken[-1]) == (7, False), "each holds a stretch of video"
        assert not closed
    finally:
        worker.close()
    worker.raise_error()
    assert closed, "the models that one in the middle has checked out would never be given back"


def test_a_ground_that_never_comes_to_rest_still_reads_what_was_kept():
    """On a slow machine the stills of an outage would be acknowledged, and never shown."""
    done, pending, at_rest = [], [], []

    def see(_picture, _hurry, _newer) -> None:
        pending.pop()
        time.sleep(0.03)
        if len(done) < 3:
            pending.append(1)
            worker.picture(PICTURE)  # there is always another

    def work():
        for step in range(3):
            at_rest.append(not pending)
            done.append(step)
            yield

    worker = patient_worker(see, lambda *_: None, lambda _stills: None, clock=time.monotonic)
    try:
        pending.append(1)
        worker.picture(PICTURE)
        assert worker.submit(work())
        eventually(lambda: len(done) == 3)
    finally:
        worker.close()
    worker.raise_error()
    assert not any(at_rest), "it was busy"


def test_a_ground_that_is_closed_keeps_what_has_come(flight, tmp_path):
    """Ctrl-C would throw away an acknowledged stretch."""
    rig = Rig(tmp_path, flight)
    rig.base(*range(25))
    rig.base(*range(65, 70))
    rig.bring(chunks(flight.session_id, "base", 40, video_object(flight, range(40, 65))))
    assert join([rig.receiver], timeout_s=200)
    assert rig.receiver.error is None
    assert not rig.receiver.failures.parts
    rig.outputs.close(within_s=60)
    assert len(Recording(tmp_path / "0.rrd").video()) == 30 + 25
    (last,) = [one for report in rig.port.reports for one in report.backlog if one.acknowledged_bytes][-1:]
    assert last.kind == "base"


def test_an_edge_that_comes_back_without_video_hands_over_what_it_stored(flight, tmp_path):
    """After a clip's last frame, or while its camera is away, it sent the same again for ever."""
    with Rig(tmp_path, flight, patience_s=0.2) as rig:
        rig.base(*range(5))
        rig.port.present.clear()
        eventually(lambda: len(rig.ended) == 1)
        rig.port.present.set()
        assert rig.still(12, 0) in rig.acknowledged_ranges()
        rig.base(*range(40, 45))
        assert len(rig.opened) == 2, "the video that comes later is of the same session"
        assert rig.session.frames_decoded == 5
    assert len(Recording(tmp_path / "1.rrd").stills()) == 1


def test_a_stored_thing_that_cannot_be_worked_off_ends_nothing_else(flight, tmp_path, caplog):
    """A full disk under an old recording would end the picture of now; or what was stored would be lost with it."""
    former = Flight(45, keyframes=(40,))
    with Rig(tmp_path, flight) as rig:
        rig.base(*range(5))
        session = rig.session
        (tmp_path / "backlog-0.rrd").mkdir()  # no file can be made there
        rig.facts(former)
        assert rig.still(12, 0, of=former) not in rig.acknowledged_ranges(), "it is to come again"
        rig.base(*range(5, 25))
        assert rig.receiver.session is session
        assert session.frames_decoded == 25
        assert [one.working for one in rig.failures.parts] == [False]
        (tmp_path / "backlog-0.rrd").rmdir()
        eventually(lambda: rig.failures.parts[0].working)
        rig.still(12, 0, of=former)
        later = [one for one in rig.acknowledged_ranges() if one.kind == "still"]
        assert any(one.acknowledged_bytes > 0 for one in later), "now it can be written"
    assert len(Recording(tmp_path / "backlog-0.rrd").stills()) == 1
