"""``--profile auto``: sends tracks and stills while their measured gain is worth their bits.

Both cost bits that the video could have.

**Tracks** pay if the detector knows the view, and the ground's misses objects on the base, or finds false ones: their
gain in F1 is the shadow ground's measurement, less the gain of video by the same bits. **Stills** pay if they change
the ground's list: it reports the outcome of each. If hardly any changed the list they pause, and a few are sent now
and then as a test. If the source is much finer than the base, they never pause, because they show details.

False reports of a ground can stop stills and tracks or bring them back, and with them move some of the bits of the
video, within auto's bounds. They cannot change the budget.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from dataclasses import dataclass, replace

from hvt_common.units import SECOND_NS
from hvt_edge.operating import AutoDecisions, Operating


@dataclass(frozen=True, slots=True)
class Measured:
    """The shadow ground's gains of tracks (see `hvt_edge.perception`); zero at first. Gains are of F1, 0…1."""

    comparisons: float = 0.0
    """Weight of the comparisons behind the gains."""
    gain: float = 0.0
    """The gain of sending tracks."""
    sure_gain: float = 0.0
    """The gain without one standard error of the changes: near zero where it rests on few objects."""
    hidden: float = 0.0
    """Objects in a picture that the base does not show."""
    suppressed: float = 0.0
    """Objects in a picture that only the base shows, and that the ground lists without the edge's tracks."""
    misnamed: float = 0.0
    """Objects in a picture that the base shows under another class."""
    misnamed_share: float = 0.0
    """Share of the shown objects that have another class there."""
    reported: bool = False
    """The ground's own detector shows even fewer objects: ``hidden`` are those that it misses."""
    moved: float = 0.0
    """Change of the gain at the last comparison."""


@dataclass(frozen=True, slots=True)
class AutoSettings:
    """The thresholds at which tracks and stills are worth their bits. Gains are of F1, 0…1."""

    tracks_bps: int
    """Line bits a second that tracks take of the budget."""
    least_gain: float = 0.005
    """Tracks are sent from this sure net gain on, until the net gain, sure or not, falls below it."""
    gain_per_doubling: float = 0.07
    """Gain of video by twice the bits: .05 to .11 between 100 and 400 kbps (docs/design-notes/study-results.md)."""
    least_comparisons: float = 1.5
    """Comparisons before tracks are sent, because a single picture may be an exception, unless …"""
    plain_gain: float = 0.2
    """… the net gain reaches this; also where hardly any of it is sure, because there is only one object."""
    least_answers: int = 12
    """Answered stills before stills may pause."""
    most_answers: int = 40
    """The newest answers that count."""
    least_changed: float = 0.1
    """The share of stills that must change something."""
    finer: bool = False
    """The source is so much finer than the base that stills always show more: they never pause."""
    pause_ns: int = 20 * SECOND_NS
    """How long stills pause before some are tried again; twice as long after each vain try, up to 8 times."""
    most_pauses: int = 8

    def net_gain(self, gain: float, *, total_bps: int) -> float:
        """The gain of tracks, less the gain of video by the same bits."""
        share = min(0.9, self.tracks_bps / total_bps)
        return gain - self.gain_per_doubling * math.log2(1 / (1 - share))

    def tracks_pay(self, measured: Measured, *, total_bps: int, sent: bool = False) -> bool:
        """Whether to send tracks, by the measurements; ``sent``: they are being sent."""
        if measured.comparisons and self.net_gain(measured.gain, total_bps=total_bps) >= self.plain_gain:
            return True
        # Where the ground sees more than the edge found, the sure gain may be larger: else tracks would come and go.
        gain = max(measured.gain, measured.sure_gain) if sent else measured.sure_gain
        enough = measured.comparisons >= self.least_comparisons
        return enough and self.net_gain(gain, total_bps=total_bps) >= self.least_gain


class AutoControl:
    """Takes measurements in the thread of perception, and sets ``operating.now.decisions``. No clock of its own."""

    def __init__(self, operating: Operating, settings: AutoSettings) -> None:
        self._operating = operating
        self._settings = settings
        self._lock = threading.Lock()
        self.measured = Measured()
        self.unlike = False
        """The detector does not know the view: any gain in its detections is a gain in guesses."""
        self._changed: deque[bool] = deque(maxlen=settings.most_answers)
        self._paused_until_ns: int | None = None
        self._pauses = 1
        self._too_slow = False
        operating.set(decisions=AutoDecisions(tracks=False))

    def take_answer(self, *, changed: bool) -> None:
        """A ground has inspected a still; ``changed``: only by that still it names another object than the edge."""
        self._changed.append(changed)

    def take_load(self, *, too_slow: bool, now_ns: int) -> None:
        """``too_slow``: the detector does not run any more. From any thread.

        It decides at once, because perception may never get to decide.
        """
        self._too_slow = too_slow
        if too_slow:
            self.decide(now_ns)

    def forget(self) -> None:
        """The scene has changed: measurements of the last one say nothing of the new one."""
        self.measured = Measured()
        self._changed.clear()
        self._paused_until_ns, self._pauses = None, 1

    def decide(self, now_ns: int) -> AutoDecisions:
        """Decide by the present measurements; ``now_ns`` is the time of the budget's windows."""
        with self._lock:
            before, settings, total_bps = (
                self._operating.now.decisions,
                self._settings,
                self._operating.now.total_bps,
            )
            able = not (self.unlike or self._too_slow)
            tracks = able and settings.tracks_pay(self.measured, total_bps=total_bps, sent=before.tracks)
            # Tracks carry classes too; without tracks only a still can correct a class.
            named = tracks or self.measured.misnamed_share < settings.least_changed
            wanted = settings.finer or self._stills(now_ns) or not named
            stills = wanted and not self._too_slow
            decisions = AutoDecisions(tracks, stills, self._says(tracks=tracks, stills=stills))
            if decisions != before:
                self._operating.set(decisions=decisions)
            return decisions

    @property
    def stable(self) -> bool:
        """Whether the decision on tracks stays the same if the gain changes by twice its last change."""
        now, sent = self.measured, self._operating.now.decisions.tracks
        margin = max(self._settings.least_gain, 2 * now.moved)
        near = (replace(now, gain=now.gain + by, sure_gain=now.sure_gain + by) for by in (-margin, margin))
        bps = self._operating.now.total_bps
        judged = [self._settings.tracks_pay(one, total_bps=bps, sent=sent) for one in near]
        return self.unlike or judged[0] == judged[1]

    def _stills(self, now_ns: int) -> bool:
        settings = self._settings
        if self._paused_until_ns is not None:
            if now_ns < self._paused_until_ns:
                return False
            self._paused_until_ns = None
            self._pauses = min(settings.most_pauses, 2 * self._pauses)
            while len(self._changed) > settings.least_answers // 2:  # some are tried, no more
                self._changed.popleft()
        changed_share = sum(self._changed) / max(1, len(self._changed))
        if len(self._changed) < settings.least_answers or changed_share >= settings.least_changed:
            return True
        self._paused_until_ns = now_ns + self._pauses * settings.pause_ns
        return False

    def _says(self, *, tracks: bool, stills: bool) -> str:
        if self._too_slow:
            return "video alone: this machine is too slow for the detector"
        measured = self.measured
        who = "the ground misses" if measured.reported else "the video hides"
        hidden = f"{who} {measured.hidden:.0f} object{'s' * (round(measured.hidden) != 1)}"
        for count, what in ((measured.suppressed, "shows {} false"), (measured.misnamed, "misnames {}")):
            if round(count):
                hidden += f", {what.format(f'{count:.0f}')}"
        why = hidden if measured.comparisons else "not measured yet"
        if self.unlike:
            why = "this view is unlike what the detector knows"
        of_tracks = f"{'tracks' if tracks else 'no tracks'}: {why}"
        renamed = f"they name {sum(self._changed)} of {len(self._changed)} otherwise"
        renamed = renamed if self._changed else "no answer yet"
        details = "stills show details, " if self._settings.finer else "stills: "
        return f"{of_tracks}; {details if stills else 'stills paused: '}{renamed}"
