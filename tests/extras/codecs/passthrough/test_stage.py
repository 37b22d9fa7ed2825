"""A camera's own units through the stage: real HEVC, real budget, real store; nothing follows what is missing."""

import time
from dataclasses import replace
from itertools import accumulate, pairwise, product
from pathlib import Path
from typing import cast

import av
import pytest

from hvt_archive.local_copy import LocalCopy
from hvt_codecs.passthrough.camera import Passthrough
from hvt_codecs.passthrough.sources import CodedVideoSource
from hvt_codecs.passthrough.stage import (
    FullestWindow,
    LeastLink,
    PassthroughStage,
    about_keyframes,
    check_camera,
    measure_camera,
    needed_bps,
)
from hvt_codecs.passthrough.stream import CameraStream, SeenUnit
from hvt_common.errors import UserError
from hvt_common.protocol.ledger import Account, Ledger
from hvt_common.runtime.failures import Failures
from hvt_common.units import SECOND_NS, bitrate_text
from hvt_common.video.hevc import BaseDecoder
from hvt_edge.backlog.stage import BacklogStage, State
from hvt_edge.link.budget import BudgetSettings, RollingBudget
from hvt_edge.operating import Keyframes, KeyframeSettings, base_rate_bps
from hvt_edge.video.encoder import EncoderSettings
from hvt_edge.video.qualification import allowed, line_bytes
from media.clips import START_NS, hard_pictures, smooth_pictures
from media.hevc_camera import SIZE, write_clip
from rigs import keeping
from rigs.world import Puts, make_transmitter

CODES_NOTHING = Passthrough(EncoderSettings(SIZE, fps=15, bitrate_bps=800_000))


class Rig:
    """A stage with all that it needs, without a store; ``paused_ns`` counts what it has waited."""

    def __init__(self, *, budget_bps: int = 800_000, waits: bool = True, **parts) -> None:
        self.kept, self.failures, self.ledger = Puts(), Failures(time.time_ns), Ledger()
        self.now_ns = START_NS
        self.keyframes = Keyframes(KeyframeSettings(interval_ns=0, camera_every_s=2.0))
        self.stage = PassthroughStage(
            CODES_NOTHING,
            keyframes=self.keyframes,
            transmitter=make_transmitter(
                self.kept,
                ledger=self.ledger,
                budget=(budget_bps, budget_bps),
                wait_until=lambda at_ns: self.wait(at_ns - self.now_ns),
            ),
            failures=self.failures,
            pause=self.wait if waits else None,
            **parts,
        )

    def wait(self, pause_ns: int) -> int:
        self.now_ns += max(0, pause_ns)
        return self.now_ns

    def play(self, frames) -> list[int]:
        """Indices of the frames that were sent."""
        sent = []
        for frame in frames:
            self.now_ns = max(self.now_ns, frame.capture_ns)
            decision = self.stage.decide(frame, now_ns=self.now_ns)
            unit = self.stage.encode(frame, decision, now_ns=self.now_ns)
            if unit is not None:
                self.stage.send(unit, decision, now_ns=self.now_ns)
                sent.append(frame.index)
        return sent

    def worst_bps(self) -> int:
        return self.ledger.summary(6.0).worst_window_bps.total


def frames_of(folder: Path, pictures, **settings):
    clip = write_clip(folder / "camera.mp4", pictures, **settings)
    with Passthrough.open_source(str(clip), size=SIZE, fps=15) as source:
        return list(source.frames(start_ns=START_NS))


@pytest.fixture(scope="module")
def burst(tmp_path_factory):
    """Six seconds, of which one is a scene that costs much more; a keyframe each second."""
    pictures = smooth_pictures(90, size=SIZE)
    pictures[35:50] = hard_pictures(15, size=SIZE)
    return frames_of(tmp_path_factory.mktemp("burst"), pictures, keyint=15, more="qp=28")


LIVE, OFFLINE, RETURNING = State.LIVE, State.OFFLINE, State.RETURNING
ANY, NO, YES = (False, True), (False,), (True,)
ALL, LINK, STORE = ("", "link", "store"), ("link",), ("store",)

# link, keyframe, where the unit before it went, admitted, probe due: where it goes. ANY, ALL: it does not matter.
TABLE = [
    (LIVE, YES, ALL, YES, ANY, "link"),
    (LIVE, NO, LINK, YES, ANY, "link"),
    (LIVE, NO, ("", "store"), YES, ANY, ""),
    (LIVE, ANY, ALL, NO, ANY, ""),
    (RETURNING, YES, ALL, YES, ANY, "link, resumes"),
    (RETURNING, YES, ALL, NO, ANY, "store"),
    (RETURNING, NO, STORE, ANY, ANY, "store"),
    (RETURNING, NO, ("", "link"), ANY, ANY, ""),
    (OFFLINE, YES, ALL, NO, ANY, "store"),
    (OFFLINE, YES, ALL, YES, NO, "store"),
    (OFFLINE, YES, ALL, YES, YES, "link, store"),
    (OFFLINE, NO, STORE, NO, ANY, "store"),
    (OFFLINE, NO, STORE, YES, NO, "store"),
    (OFFLINE, NO, STORE, YES, YES, "link, store"),
    (OFFLINE, NO, ("", "link"), ANY, ANY, ""),
]


class Store:
    """As much of the backlog as a decision needs."""

    state, segment_open, probes = LIVE, True, False

    def probe_due(self, _now_ns: int, *, keyframe: bool) -> bool:
        del keyframe
        return self.probes

    def resume(self) -> None:
        """The link has the stream again."""


def test_each_unit_goes_where_the_table_says(burst):
    """A unit would be sent that builds on one which nobody has, or one be left out that could have gone."""
    decided = {}
    for *columns, goes in TABLE:
        for row in product((columns[0],), *columns[1:]):
            assert decided.setdefault(row, goes) == goes, "two lines of the table contradict"
    assert len(decided) == 3 * 2 * 3 * 2 * 2
    for (link, keyframe, before, admitted, probes), goes in decided.items():
        room, store = [True], Store()
        rig = Rig(admits=lambda *_, room=room: room[0], waits=False)
        rig.stage.backlog = cast("BacklogStage", store)
        if before:
            store.state = LIVE if before == "link" else OFFLINE
            rig.stage.encode(burst[0], rig.stage.decide(burst[0], now_ns=rig.now_ns), now_ns=rig.now_ns)
        store.state, store.probes, room[0] = link, probes, admitted
        unit, sent = replace(burst[1].camera_unit, keyframe=keyframe), rig.keyframes.sent
        frame = replace(burst[1], camera_unit=unit)
        decision = rig.stage.decide(frame, now_ns=rig.now_ns)
        named = {"link": decision.to_link, "store": decision.to_store, "resumes": decision.resumes}
        assert ", ".join(one for one, yes in named.items() if yes) == goes, (link, keyframe, before, probes)
        assert (decision.codes, decision.keyframe) == (bool(goes), keyframe and bool(goes))
        rig.stage.encode(frame, decision, now_ns=rig.now_ns)
        assert rig.keyframes.sent == sent + (keyframe and bool(goes)), "the camera's own is what comes"


def test_nothing_follows_a_unit_for_which_the_link_had_no_room_after_all(burst, monkeypatch):
    """Every ground would show garbage up to the next keyframe."""
    rig = Rig()
    assert rig.play(burst[:3]) == [0, 1, 2]
    with monkeypatch.context() as patched:
        patched.setattr(rig.stage.transmitter, "base", lambda *_, **__: 0)
        rig.play(burst[3:4])
    decision = rig.stage.decide(burst[4], now_ns=rig.now_ns)
    assert decision.held_by == "budget", "none was lost at the camera"
    assert rig.play(burst[5:18]) == [15, 16, 17]


@pytest.mark.parametrize("waits", [True, False])
def test_what_breaks_the_budget_is_left_out_up_to_the_next_keyframe(burst, waits):
    """A scene that suddenly costs more would break the budget, or every ground show garbage."""
    rig = Rig(budget_bps=200_000, waits=waits)
    sent = rig.play(burst)
    assert rig.worst_bps() <= 200_000
    assert 0 < rig.stage.left_out == 90 - len(sent) < 60
    assert sent[-15:] == list(range(75, 90)), "it is back when the scene is"
    keys = {frame.index for frame in burst if frame.camera_unit.keyframe}
    assert all(two == one + 1 or two in keys for one, two in pairwise(sent))
    decoder = BaseDecoder(size=SIZE)
    assert all(decoder.decode(unit) is not None for unit in rig.kept.units)
    assert [one.sequence for one in rig.kept.base] == list(range(len(sent))), "no ground takes it for lost"
    (part,) = rig.failures.parts
    assert (part.part, part.working) == ("passthrough", True)
    assert "the budget's window has no room for a " in part.reason
    assert "nothing is sent up to the camera's next keyframe" in part.reason


def test_a_unit_that_no_window_holds_costs_no_time(burst):
    """The loop would wait for what never comes, and every frame behind it."""
    rig = Rig(budget_bps=20_000)
    large = next(frame for frame in burst[35:50] if len(frame.camera_unit.data) > 3000)
    assert rig.play([replace(large, camera_unit=replace(large.camera_unit, keyframe=True))]) == []
    assert rig.now_ns == large.capture_ns


def test_a_link_that_is_busy_for_a_moment_costs_nothing(burst):
    """Behind each large keyframe the picture would stand still up to the next."""
    busy_until = START_NS + 3 * SECOND_NS // 10
    rig = Rig(admits=lambda now_ns, *_size: now_ns >= busy_until)
    assert rig.play(burst[:30]) == list(range(30))
    assert rig.now_ns >= busy_until
    busy = Rig(
        admits=lambda now_ns, *_size: not 0 < now_ns - START_NS - SECOND_NS // 2 < 2 * SECOND_NS,
        holder=lambda _now_ns: "link",
    )
    sent = busy.play(burst)
    assert sent[:5] == list(range(5))
    assert (20 in sent, 45 in sent) == (False, True)
    assert "the link has no room for" in busy.failures.parts[0].reason


def test_a_frame_that_the_source_lost_is_waited_for_to_be_made_good(burst):
    """What builds on it is garbage everywhere, and nobody would say so."""
    sent = Rig().play([frame for frame in burst if frame.index not in (20, 21)])
    assert sent == [*range(20), *range(30, 90)]


def test_the_local_copy_has_what_was_not_sent(burst, tmp_path):
    """The only whole copy of the flight would have the holes of the link."""
    with LocalCopy(tmp_path / "copy.mkv", failures=Failures(time.time_ns), wait=True) as copy:
        rig = Rig(budget_bps=200_000, local_copy=copy)
        sent = rig.play([frame for frame in burst if frame.index != 5])
    assert len(sent) < 80
    with av.open(str(tmp_path / "copy.mkv")) as container:
        whole = len(list(container.decode(video=0)))
    assert whole == 90 - 10, "all but from the lost one up to the next keyframe"


def test_a_ground_that_asks_for_a_keyframe_is_told_when_one_comes(burst):
    """It would ask again and again, and stills be held for a keyframe that nobody makes."""
    rig = Rig()
    assert rig.keyframes.due(START_NS), "before the first"
    rig.play(burst[:5])
    refusal = rig.keyframes.request(rig.now_ns)
    assert refusal is not None
    assert "makes no keyframe on request: the next comes by itself, one each 2.0 s or so" in refusal
    rig.keyframes.require(rig.now_ns)
    assert not rig.keyframes.due(rig.now_ns)
    assert rig.keyframes.sent == 1
    assert rig.ledger.messages(Account.BASE) == 5


def test_an_outage_is_stored_from_keyframe_to_keyframe(tmp_path):
    """What is kept while the link is away could not be shown, or what follows be garbage at the ground."""
    frames = frames_of(tmp_path, smooth_pictures(90, size=SIZE), keyint=15)
    rig = keeping.Rig(tmp_path / "store")
    parts = {"keyframes": rig.keyframes, "transmitter": rig.sender, "failures": rig.failures}
    rig.stage = PassthroughStage(CODES_NOTHING, **parts, admits=rig.admits, backlog=rig.backlog)
    for frame in frames:
        rig.now_ns, rig.linked = frame.capture_ns, not 35 <= frame.index < 62
        rig.link_control.before_frame(rig.now_ns)
        rig.base(frame)
    sent = [header.frame_index for header in rig.out.base]
    assert sent == [*range(35), *range(75, 90)]
    assert [header.sequence for header in rig.out.base] == list(range(50)), "no hole for what was kept"
    kept = {unit.frame_index: unit for unit in rig.kept()}
    assert kept.keys() == {*range(35), *range(45, 75)}, "what was on its way, and from the next keyframe on"
    decoder = BaseDecoder(size=SIZE)
    for index in range(45, 75):
        assert kept[index].data == frames[index].camera_unit.data
        assert decoder.decode(kept[index].data) is not None


WHOLE = {"window_s": 1.0, "edge_id": "edge-1"}


def stream_of(sizes: list[int], gaps_s: list[float], keyframes: set[int]) -> CameraStream:
    """A camera that sends units of these sizes at these distances."""
    times = accumulate(gaps_s[: len(sizes) - 1], initial=0.0)
    pairs = enumerate(zip(times, sizes, strict=True))
    return CameraStream(
        tuple(SeenUnit(at_s, size, index in keyframes) for index, (at_s, size) in pairs), 15.0
    )


def test_the_fullest_window_is_any_window_by_the_cameras_times():
    """A camera that bunches its frames would be taken for one that does not."""
    sizes = [5000, *[100] * 9, 5000, *[100] * 9]
    key, other = (line_bytes(size, "edge-1") for size in (5000, 100))
    even = measure_camera(stream_of(sizes, [0.25] * 20, {0, 10}), **WHOLE)
    assert even.window_bytes == key + 3 * other
    assert even.keyframe_bytes == key
    bunched = measure_camera(stream_of(sizes, [0.25] * 5 + [0.01] * 14, {0, 10}), **WHOLE)
    assert bunched.window_bytes == key + 17 * other, "all but the first two"


def test_a_camera_that_takes_too_much_is_refused_with_its_figure(tmp_path):
    """Most of its pictures would be left out, and nobody say why."""
    clip = write_clip(tmp_path / "a.mp4", hard_pictures(45, size=SIZE), more="qp=30")
    with Passthrough.open_source(str(clip), size=SIZE, fps=15) as source:
        assert isinstance(source, CodedVideoSource)
        stream = source.camera_stream
    takes_bps = 8 * measure_camera(stream, **WHOLE).window_bytes

    def check(budget_bps: int) -> str:
        limit = allowed(size=SIZE, fps=15, total_bps=budget_bps, base_bps=budget_bps, window_s=1.0)
        return check_camera("cam", stream, limit, budget_bps=budget_bps, edge_id="edge-1")

    assert check(round(1.01 * takes_bps)).startswith("source cam is passed through: 15 fps, ")
    too_little = round(0.99 * takes_bps)
    with pytest.raises(UserError) as caught:
        check(too_little)
    said, left = str(caught.value), bitrate_text(too_little)
    assert said.startswith(f"source cam makes {bitrate_text(takes_bps)} in its fullest 1 s (")
    assert f"--budget {left} leaves {left} for it: re-encode it with --encoder x265" in said


def test_a_camera_with_few_keyframes_is_told_of():
    """A ground that joins would wait for a picture, and the operator for an explanation."""
    rare = stream_of([100] * 60, [0.1] * 60, {0})
    assert "goes 6 s without a keyframe" in about_keyframes("cam", rare)
    assert about_keyframes("cam", stream_of([100] * 60, [0.1] * 60, {0, 20, 40})) == ""


@pytest.mark.parametrize("share", [1.0, 0.85, 0.5])
@pytest.mark.parametrize("metadata_bps", [0, 40_000])
def test_what_is_needed_has_room_for_the_fullest_window(share, metadata_bps):
    """A floor that is a little too low is as bad as none: what follows a keyframe would never go out."""
    sizes = [15_000, *[1200] * 24]
    total_bps = needed_bps(sum(sizes), window_s=1.0, share=share, metadata_bps=metadata_bps)
    base_bps = base_rate_bps(total_bps, share, metadata_bps=metadata_bps)
    budget = RollingBudget(BudgetSettings(total_bps, base_bps, fps=25))
    for index, size in enumerate(sizes * 3):
        now_ns = index * SECOND_NS // 25
        assert budget.earliest_ns(size, now_ns=now_ns, base=True) == now_ns
        assert budget.fits(size, now_ns=now_ns)
        budget.record_base(size, now_ns=now_ns)


def test_a_clock_that_is_set_back_makes_no_window_fuller():
    """The camera would be refused for what it does not take."""
    window = FullestWindow(SECOND_NS)
    held = [
        window.add(100, at_ns=at_ns) for at_ns in (0, SECOND_NS // 2, SECOND_NS, -SECOND_NS, -SECOND_NS // 2)
    ]
    assert held == [100, 200, 200, 100, 200]
    assert window.most_bytes == 200


def test_a_link_is_free_when_all_is_reported_or_had_its_time():
    """A queue would grow on a thin link, or a link that has lost something be waited for."""
    unreported = [0]
    least = LeastLink(100_000, unreported_bytes=lambda: unreported[0])
    for number in range(1, 100):  # reports follow some way behind: what they name waits no more
        unreported[0] = min(12_500, number * 1250)
        least.sent(1250, now_ns=number)
    assert not least.is_free(SECOND_NS // 2)
    assert least.is_free(2 * SECOND_NS), "as long as for what is not reported, not for all"
    least.sent(12_500, now_ns=2 * SECOND_NS)
    unreported[0] = 25_000
    assert not least.is_free(2 * SECOND_NS)
    unreported[0] = 0
    assert least.is_free(2 * SECOND_NS)
