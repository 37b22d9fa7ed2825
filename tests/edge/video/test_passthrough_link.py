"""A camera's own units over a link that goes, thins out and comes back: the real pacer, rates and budget."""

from collections import Counter

import numpy as np
import pytest

from hvt_common.protocol.ledger import Ledger
from hvt_common.protocol.messages import BaseHeader
from hvt_common.runtime.failures import Failures
from hvt_common.units import SECOND_NS
from hvt_common.values import CameraUnit, Frame
from hvt_edge.config import EdgeConfig, check
from hvt_edge.operating import Keyframes, KeyframeSettings
from hvt_edge.source.contract import CameraStream, SeenUnit
from hvt_edge.video.passthrough import Passthrough, PassthroughStage
from hvt_edge.wiring.link import make_budget, make_camera_rates, make_least_link, make_pacer
from media.clips import START_NS
from rigs.messages import counted, feedback
from rigs.world import make_operating, make_reconfiguration, make_transmitter

SIZE, FPS = (1280, 720), 25
PIXELS = np.zeros((8, 8, 3), np.uint8)
BUDGET_BPS = 800_000
_REPORT_NS, _WAY_NS = SECOND_NS // 5, SECOND_NS // 50


def camera(
    seconds: float, *, key_bytes: int, every_s: float = 2.0, rest_bytes: int = 1200
) -> list[CameraUnit]:
    """Units of a camera at 25 fps."""
    every = round(every_s * FPS)
    sizes = [rest_bytes if index % every else key_bytes for index in range(round(seconds * FPS))]
    return [CameraUnit(b"\1" * size, keyframe=not index % every) for index, size in enumerate(sizes)]


class Flight:
    """An edge, a link that carries ``link_bps(seconds)`` (0: it is away), and a ground that reports."""

    def __init__(
        self, *, surveyed, link_bps, budget_bps=BUDGET_BPS, share=1.0, adapt=True, min_budget=None
    ) -> None:
        given = {"budget": budget_bps, "video_share": share, "adapt": adapt, "min_budget": min_budget}
        method = {"method": "M0"} if share == 1.0 else {}
        self.config = config = check(
            EdgeConfig(source="camera.mp4", encoder="passthrough", fps=FPS, **given, **method)
        )
        units = [SeenUnit(index / FPS, len(one.data), one.keyframe) for index, one in enumerate(surveyed)]
        stream = CameraStream(tuple(units), FPS)
        self.now_ns = START_NS
        self.link_bps, self.free_ns = link_bps, START_NS
        self.arrivals: list[tuple[int, BaseHeader]] = []
        self.late_s: list[float] = []
        """How old each unit was when the ground had it."""
        self.seconds: Counter[int] = Counter()
        """Frames that the ground has got, by the second in which they were taken."""
        self.operating = make_operating(config)
        self.pacer = make_pacer(config, stream, SIZE)
        self.ledger = Ledger()
        self.transmitter = make_transmitter(
            self,
            ledger=self.ledger,
            budget=make_budget(config, base_bps=config.base_bps, decimation=1),
            wait_until=lambda at_ns: self.wait(at_ns - self.now_ns),
            pacer=self.pacer,
        )
        self.reconfiguration = make_reconfiguration(
            self.operating, config, SIZE, self.transmitter, pacer=self.pacer
        )
        self.stage = PassthroughStage(
            Passthrough(),
            keyframes=Keyframes(KeyframeSettings(interval_ns=0, camera_every_s=stream.keyframe_s)),
            transmitter=self.transmitter,
            failures=Failures(lambda: self.now_ns),
            rates=make_camera_rates(config, stream, self.reconfiguration),
            least_link=make_least_link(config, self.transmitter),
            admits=self.admits,
            pause=self.wait,
        )
        self._reported_ns = START_NS
        self._first = True

    def admits(self, now_ns: int, _line_bytes: int, _coding_ns: int) -> bool:
        if self.pacer is None:
            return True
        return self.pacer.admits_base(now_ns) and self.transmitter.base_wait_ns(now_ns) <= SECOND_NS // 10

    def put(self, _channel, payload, *, attachment=None, encoding="") -> None:
        """The link takes a message; one that goes out while it is away is lost."""
        del encoding
        line_bytes = len(payload) + len(attachment) + 120
        rate_bps = self.link_bps((self.now_ns - START_NS) / SECOND_NS)
        if rate_bps:
            self.free_ns = max(self.free_ns, self.now_ns) + 8 * SECOND_NS * line_bytes // rate_bps
            self.arrivals.append((self.free_ns + _WAY_NS, BaseHeader.parse(attachment, payload)))

    def wait(self, pause_ns: int) -> int:
        """Time goes by, and the ground reports."""
        until_ns = self.now_ns + max(0, pause_ns)
        while self._reported_ns + _REPORT_NS <= until_ns:
            self._reported_ns += _REPORT_NS
            self._report(self._reported_ns)
        self.now_ns = until_ns
        return until_ns

    def _report(self, at_ns: int) -> None:
        got = [(when, header) for when, header in self.arrivals if when <= at_ns - _WAY_NS]
        if self.pacer is None or not self.link_bps((at_ns - START_NS) / SECOND_NS) or not got:
            return
        when, header = got[-1]
        said = feedback(
            session_id=1,
            base_sequence=header.sequence,
            still_sequence=-1,
            base_held_us=(at_ns - _WAY_NS - when) // 1000,
            send_ns=at_ns - _WAY_NS,
            lost=0,
        )
        self.pacer.on_report(counted(said, now_ns=at_ns, first=self._first))
        self.transmitter.in_flight.on_report(header.sequence)
        self._first = False

    def fly(self, units, *, before=lambda _second: None) -> list[int]:
        """Send them; return how many frames of each second the ground has got. ``before`` runs before each frame."""
        for index, unit in enumerate(units):
            taken_ns = START_NS + index * SECOND_NS // FPS
            self.wait(max(0, taken_ns - self.now_ns))
            if self.pacer is not None:
                self.pacer.link(True, now_ns=self.now_ns)
            self.reconfiguration.track_link(self.now_ns)
            before(index / FPS)
            frame = Frame(index, taken_ns, PIXELS, PIXELS, camera_unit=unit)
            decision = self.stage.decide(frame, now_ns=self.now_ns)
            coded = self.stage.encode(frame, decision, now_ns=self.now_ns)
            if coded is not None:
                self.stage.send(coded, decision, now_ns=self.now_ns)
        self.late_s = [(when - header.capture_ns) / SECOND_NS for when, header in self.arrivals]
        self.seconds.update((header.capture_ns - START_NS) // SECOND_NS for _, header in self.arrivals)
        return [self.seconds[second] for second in range(len(units) // FPS)]


def link(*, away: tuple[float, float] = (0.0, 0.0), carries_bps: int = 0):
    """Ten megabits a second, and less for a while: nothing, or as much as it ``carries_bps``."""
    return lambda second: carries_bps if away[0] <= second < away[1] else 10_000_000


@pytest.mark.parametrize("share", [1.0, pytest.param(0.85, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("every_s", [1.0, pytest.param(2.0, marks=pytest.mark.nightly), 4.0])
@pytest.mark.parametrize(
    ("surveyed_bytes", "key_bytes"), [(15_000, 15_000), (15_000, 45_000), (8_000, 70_000)]
)
def test_a_link_that_was_away_for_a_moment_does_not_end_the_video(surveyed_bytes, key_bytes, every_s, share):
    """Four seconds without a link would be the end of the video, also where the scene costs more than before."""
    surveyed = camera(8, key_bytes=surveyed_bytes, every_s=every_s)
    flight = Flight(surveyed=surveyed, link_bps=link(away=(10, 14)), share=share)
    got = flight.fly(camera(32, key_bytes=key_bytes, every_s=every_s))
    assert got[10:13] == [0, 0, 0], "the link was away"
    assert got[20:] == [FPS] * 12, "the third keyframe behind it at the latest goes on"
    assert flight.ledger.worst_window_bps.total <= BUDGET_BPS


@pytest.mark.parametrize("key_bytes", [20_000, 50_000])
def test_a_link_that_carries_less_than_the_camera_makes_gets_no_queue(key_bytes):
    """The picture would be a minute old, and the older the longer the link stays thin."""
    flight = Flight(
        surveyed=camera(8, key_bytes=key_bytes, every_s=1.0),
        link_bps=link(away=(10, 50), carries_bps=100_000),
    )
    got = flight.fly(camera(60, key_bytes=key_bytes, every_s=1.0))
    assert max(flight.late_s) < 12
    assert all(sum(got[second : second + 14]) for second in range(10, 46)), "something is shown"
    assert got[-6:] == [FPS] * 6
    assert flight.ledger.worst_window_bps.total <= BUDGET_BPS


@pytest.mark.parametrize("adapt", [True, False])
def test_a_budget_that_was_lowered_too_far_can_be_raised_again(adapt):
    """One wrong number from a ground would end the video: the edge would never look at another."""
    flight = Flight(surveyed=camera(8, key_bytes=15_000), link_bps=link(), adapt=adapt)

    def command(second: float) -> None:
        bps = {5.0: 60_000, 15.0: BUDGET_BPS}.get(second)
        if bps is not None:
            flight.operating.set(budget_bps=bps)

    got = flight.fly(camera(30, key_bytes=15_000), before=command)
    assert got[8:15] == [0] * 7, "no window of 60 kbps holds its keyframes"
    assert got[:5] == [FPS] * 5
    assert got[18:] == [FPS] * 12
    assert flight.transmitter.budget.total_bps > 300_000


def test_without_reports_all_goes_out():
    """Somebody who only listens would get a keyframe now and then."""
    flight = Flight(surveyed=camera(8, key_bytes=15_000), link_bps=link())
    flight.pacer.on_report = lambda _report: None
    got = flight.fly(camera(12, key_bytes=15_000))
    assert sum(got) > 9 * FPS
    assert got[-6:] == [FPS] * 6
