"""The results of a run for the link's users: numbers from arrivals, summaries and samples, and whether bars hold."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from lab.link.measures.resources import Sample, more_at_the_end, slope_mb_per_hour
from lab.link.measures.rows import row
from lab.link.measures.store_left import StoreLeft
from lab.link.measures.timing import Arrival
from lab.link.timeline import Script

_RESOURCES: Mapping[str, Callable[[Sample], float]] = {
    "memory MB": lambda sample: sample.resident_mb,
    "descriptors": lambda sample: sample.descriptors,
    "threads": lambda sample: sample.threads,
}
KINDS = ("base", "roi", "tracks", "backlog-still", "backlog-base", "backlog-info")
"""Kinds of messages that the budget is for."""
STORED_FROM = 2**31
"""Number of the first still that was not sent but kept (`hvt_edge.stills.scheduler`)."""
NOTHING_STORED = StoreLeft(0, 0)
ALWAYS: Mapping[str, str] = {
    f"{name}, {what}": bar
    for name in ("edge", "ground")
    for what, bar in {
        "exit code": "== 0",
        "tracebacks": "== 0",
        "descriptors more at the end": "<= 0",
        "threads more at the end": "<= 0",
    }.items()
}
"""Bars of every scenario."""
WARM: Mapping[str, str] = {
    "edge, memory MB more at the end": "<= 128",
    "ground, memory MB more at the end": "<= 128",
}
"""Bars of runs that are long enough. The allocator goes on for two minutes; only a soak asks for flat."""
SOAK: Mapping[str, str] = {
    "edge, memory slope MB/h": "<= 1",
    "ground, memory slope MB/h": "<= 1",
    "ledger difference, bytes": "== 0",
    "stills lost": "== 0",
}
"""Bars of a run of half an hour or more."""

_STORE = ("stills", "video_s", "evicted_stills", "evicted_segments", "unreadable", "given_up")
_LIVE_S = 1.0
"""A picture that is older than this when it comes is not live."""
_RATE_WINDOW_S = 2.0
_ACCOUNTS = ("base_bytes", "roi_bytes", "backlog_bytes", "meta_bytes", "overhead_bytes")
_LEAST_WARM_S = 40.0
_LEAST_SLOPE_S = 120.0
_LEAST_SOAK_S = 1800.0


@dataclass(frozen=True)
class Outcome:
    """All that one run left. Times are Unix seconds."""

    scenario: str
    script: Script
    began_s: float
    """When the script began."""
    arrivals: list[Arrival]
    edge: Mapping[str, Any] | None
    """Its summary; None where it left none."""
    ground: Mapping[str, Any] | None
    samples: Mapping[str, list[Sample]]
    exit_codes: Mapping[str, int | None]
    """None: it had to be killed."""
    said: Mapping[str, str]
    """Standard error of both."""
    stored: StoreLeft = NOTHING_STORED
    """The rest in the edge's store."""

    @property
    def frames(self) -> list[Arrival]:
        """Base frames that came after the script's begin."""
        return [one for one in self.arrivals if one.kind == "base" and one.received_s >= self.began_s]

    @property
    def shown(self) -> list[Arrival]:
        return [one for one in self.frames if one.shown]

    @property
    def stills(self) -> list[Arrival]:
        """Stills that came after the script's begin."""
        return [one for one in self.arrivals if one.kind == "roi" and one.received_s >= self.began_s]

    @property
    def ended_s(self) -> float:
        return self.began_s + self.script.lasts_s


def measures(outcome: Outcome) -> dict[str, float | int | None]:
    """Every measure by its name; None where it cannot be said, which holds no bar."""
    found: dict[str, float | int | None] = {}
    for part in (_delays, _pictures, _after_changes, _accounts, _processes):
        found |= part(outcome)
    return found


def rows(outcome: Outcome, bars: Mapping[str, str]) -> list[dict[str, Any]]:
    """One row a measure: scenario, measure, value, bar, holds."""
    warm = WARM if outcome.script.lasts_s >= _LEAST_WARM_S else {}
    soak = SOAK if outcome.script.lasts_s >= _LEAST_SOAK_S else {}
    found, wanted = measures(outcome), {**ALWAYS, **warm, **soak, **bars}
    for measure in wanted:
        found.setdefault(measure, None)
    return [row(outcome.scenario, measure, value, wanted.get(measure)) for measure, value in found.items()]


def rate_over_time(
    outcome: Outcome,
    *,
    every_s: float = 1.0,
    of: Callable[[Arrival], float] = lambda one: one.received_s,
    kinds: Sequence[str] = KINDS,
) -> list[int]:
    """Bits a second of all that came, with all overhead, in equal steps from the script's begin.

    ``of`` says which of its times counts: when it was received, or when it was sent.
    """
    bins = [0] * max(1, math.ceil(outcome.script.lasts_s / every_s))
    for one in outcome.arrivals:
        index = math.floor((of(one) - outcome.began_s) / every_s)
        if one.kind in kinds and 0 <= index < len(bins):
            bins[index] += one.line_bytes
    return [round(8 * size / every_s) for size in bins]


def _delays(outcome: Outcome) -> dict[str, float | None]:
    frames, stills, state = outcome.frames, outcome.stills, outcome.script.at(0)
    delays = [one.delay_s for one in frames]
    sending = [one.received_s - one.send_s for one in stills]
    return {
        "frame delay p50, ms": _percentile(delays, 50, scale=1e3),
        "frame delay p95, ms": _percentile(delays, 95, scale=1e3),
        "frame delay max, ms": _percentile(delays, 100, scale=1e3),
        "frame delay p95 over floor": _ratio(_percentile(delays, 95), _frame_floor_s(outcome)),
        "still delay p95, ms": _percentile([one.delay_s for one in stills], 95, scale=1e3),
        "still sending p95, ms": _percentile(sending, 95, scale=1e3),
        "still sending p95 over floor": _ratio(
            _percentile(sending, 95),
            _still_floor_s(frames, stills, state.rate_bps, state.delay_s + state.jitter_s),
        ),
    }


def _frame_floor_s(outcome: Outcome) -> float | None:
    """The 95th percentile of one frame alone on the link: encoded as fast as this edge does, sent, carried."""
    frames, state = outcome.frames, outcome.script.at(0)
    wire_field = _percentile([8 * one.line_bytes / state.rate_bps for one in frames], 95)
    encoded = _percentile([one.send_s - one.capture_s for one in frames], 5)
    return (
        None
        if wire_field is None or encoded is None
        else encoded + wire_field + state.delay_s + state.jitter_s
    )


def _still_floor_s(
    frames: list[Arrival], stills: list[Arrival], rate_bps: int, delay_s: float
) -> float | None:
    """A still's own serialisation, behind the one P-frame that may be on the line when it is sent."""
    own = _percentile([8 * one.line_bytes / rate_bps for one in stills], 95)
    frame = _percentile([8 * one.line_bytes / rate_bps for one in frames], 50)
    return None if own is None or frame is None else own + frame + delay_s


def _pictures(outcome: Outcome) -> dict[str, float | int | None]:
    sent = outcome.edge["frames"] if outcome.edge else None
    shown_all = sum(one.kind == "base" and one.shown for one in outcome.arrivals)
    times = [outcome.began_s, *sorted(one.received_s for one in outcome.shown), outcome.ended_s]
    gap_s = max(b - a for a, b in pairwise(times) if a < outcome.ended_s)
    state, rates = outcome.script.at(0), rate_over_time(outcome)
    carries = outcome.script.carries_bits(0, outcome.script.lasts_s) / outcome.script.lasts_s
    delivered = sum(rates) / len(rates)
    return {
        "decodable frames, %": 100 * shown_all / sent if sent else None,
        "frames given up before encoding": outcome.edge["frames_dropped"] if outcome.edge else None,
        "longest without a picture, s": gap_s,
        "longest without a picture less a round trip, s": gap_s - 2 * state.delay_s,
        "delivered, kbps": delivered / 1e3,
        "delivered of what the link carries, %": 100 * delivered / carries,
    }


def _after_changes(outcome: Outcome) -> dict[str, float | None]:
    found: dict[str, float | None] = {}
    script, began_s = outcome.script, outcome.began_s
    if script.falls_s:
        found["under 1 s again after a fall, s"] = max(
            _calm_again_s(outcome, began_s + fall_s, before_s=began_s + _next_change_s(script, fall_s))
            for fall_s in script.falls_s
        )
    if script.rises_s and script.falls_s:
        found["90 % of the rate again after a rise, s"] = max(
            _rate_again_s(outcome, rise_s) for rise_s in script.rises_s
        )
    if script.dark:
        found["live again after darkness, s"] = max(
            _live_again_s(outcome, began_s + end_s) for _, end_s in script.dark
        )
        found["received in darkness, bytes"] = sum(
            one.line_bytes
            for one in outcome.frames
            # Messages on their way when it fell dark may still arrive.
            if any(begin + 1 < one.received_s - began_s < end for begin, end in script.dark)
        )
    return found


def _next_change_s(script: Script, after_s: float) -> float:
    return min([one for one in (*script.falls_s, *script.rises_s) if one > after_s], default=script.lasts_s)


def _calm_again_s(outcome: Outcome, fall_s: float, *, before_s: float) -> float:
    """From the fall until frames come under a second old, and stay so; infinite where they do not."""
    late = [one.received_s for one in outcome.frames if fall_s <= one.received_s and one.delay_s > _LIVE_S]
    late = [at for at in late if at < before_s]
    calm = [one.received_s for one in outcome.frames if max(late, default=fall_s) < one.received_s < before_s]
    return calm[0] - fall_s if calm else math.inf


def _rate_again_s(outcome: Outcome, rise_s: float) -> float:
    """From the rise until two seconds together carry 90 % of the mean before the fall."""
    step_s = 0.25
    rates = rate_over_time(outcome, every_s=step_s)
    fall_s = max(one for one in outcome.script.falls_s if one < rise_s)
    before = rates[: int(fall_s / step_s)]
    wanted = 0.9 * sum(before) / max(1, len(before))
    window = int(_RATE_WINDOW_S / step_s)
    first = int(rise_s / step_s)
    for index in range(first, len(rates) - window + 1):
        if sum(rates[index : index + window]) / window >= wanted:
            return (index + window - first) * step_s
    return math.inf


def _live_again_s(outcome: Outcome, light_s: float) -> float:
    live = [one.received_s for one in outcome.shown if one.received_s >= light_s and one.delay_s < _LIVE_S]
    return min(live) - light_s if live else math.inf


def _accounts(outcome: Outcome) -> dict[str, float | int | None]:
    edge, ground = outcome.edge, outcome.ground
    if edge is None or ground is None:
        return {"ledger difference, bytes": None, "stills lost": None}
    store = edge["store"] or dict.fromkeys(_STORE, 0)
    given_up = store["evicted_stills"] + store["given_up"] + store["unreadable"]
    found = {
        "ledger difference, bytes": sum(abs(edge[name] - ground[name]) for name in _ACCOUNTS),
        "stills lost": _stills_lost(outcome) + given_up,
        "keyframes asked for": ground["keyframe_requests"],
        "base messages lost": ground["lost"],
    }
    if any(store.values()):
        found |= {
            "stills that came afterwards": ground["backlog"]["stills"],
            "video that came afterwards, s": ground["backlog"]["video_s"],
            "stills still kept at the end": store["stills"],
            "video still kept at the end, s": store["video_s"],
            "given up by the store": given_up + store["evicted_segments"],
        }
    return found


def _stills_lost(outcome: Outcome) -> int:
    """Numbers that are nowhere: stills that are sent count from 0, those that are kept from `STORED_FROM`."""
    came = {one.sequence for one in outcome.arrivals if one.kind == "roi"}
    came |= {one.sequence for one in outcome.arrivals if one.kind == "backlog-still" and one.shown}
    reached = came | outcome.stored.stills
    lost = 0
    for first, end in ((0, STORED_FROM), (STORED_FROM, 2**32)):
        numbers = {one for one in reached if first <= one < end}
        lost += max(numbers, default=first - 1) + 1 - first - len(numbers)
    sent = outcome.edge["stills"]["reasons"]["sent"] if outcome.edge else {}
    live = sum(count for reason, count in sent.items() if reason != "stored")
    # The last ones leave no hole: they are missing in the edge's own count.
    return max(lost, live - sum(one < STORED_FROM for one in reached))


def _processes(outcome: Outcome) -> dict[str, float | int | None]:
    found: dict[str, float | int | None] = {
        f"{name}, exit code": code for name, code in outcome.exit_codes.items()
    }
    found |= {f"{name}, tracebacks": said.count("Traceback") for name, said in outcome.said.items()}
    for name, samples in outcome.samples.items():
        found[f"{name}, peak memory MB"] = max((one.resident_mb for one in samples), default=None)
        if len(samples) > 1 and samples[-1].at_s - samples[0].at_s >= _LEAST_SLOPE_S:
            found[f"{name}, memory slope MB/h"] = slope_mb_per_hour(samples)
        for what, of in _RESOURCES.items():
            found[f"{name}, {what} more at the end"] = more_at_the_end(samples, of)
    return found


def _percentile(values: Sequence[float], percent: float, *, scale: float = 1.0) -> float | None:
    return scale * float(np.percentile(values, percent)) if values else None


def _ratio(value: float | None, floor: float | None) -> float | None:
    return None if value is None or not floor else value / floor
