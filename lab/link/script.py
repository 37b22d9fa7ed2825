"""A scenario file, read, checked and made into a script of the link over time.

A script is a pure function of the file, the length and the seed: relay and namespaces play the same one.
"""

import itertools
import math
import random
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from hvt_common.errors import UserError
from hvt_common.files import read_text, toml_table
from hvt_common.units import parse_bitrate, parse_duration_s, parse_share
from lab.link.timeline import LinkState, Phase, Script

SCENARIOS = Path(__file__).parent / "scenarios"
Length = Literal["short", "full"]
Transport = Literal["tcp", "udp", "quic"]
LENGTHS: tuple[Length, ...] = ("short", "full")

_WAVE_STEP_S = 0.25
_LONGEST_S = 2 * 3600.0
_MAX_PHASES = 100_000
_MAX_DELAY_S = 5.0
_MAX_QUEUE_BYTES = 4_000_000


@dataclass(frozen=True, slots=True)
class Scenario:
    """One file of lab/link/scenarios."""

    name: str
    about: str
    budget: str
    """Budget of the edge, as its ``--budget`` takes it."""
    bars: Mapping[str, str]
    """The bars of measures: ``{"decodable frames, %": ">= 97"}``."""
    transport: Transport
    """``udp`` shows losses as losses; ``tcp`` and ``quic`` turn them into delay."""
    _tables: Mapping[str, Mapping[str, Any]] = field(repr=False)

    def script(self, length: Length, *, seed: int = 0, lasts: str | None = None) -> Script:
        """The link over time; the seed draws the bursts of loss. ``lasts`` stretches the repetitions (``60min``)."""
        plan = {**self._tables[length], **({} if lasts is None else {"lasts": lasts})}
        return _script(self.name, self._tables["link"], plan, seed=seed)


def scenario_names() -> list[str]:
    return sorted(file.stem for file in SCENARIOS.glob("*.toml"))


def load_scenario(name: str | Path) -> Scenario:
    """Read and check a scenario by its name, or any file that ends in .toml.

    Raises:
        UserError: there is none, or something in it is not usable; the sentence names the setting.
    """
    path = Path(name) if str(name).endswith(".toml") else SCENARIOS / f"{name}.toml"
    try:
        content = toml_table(read_text(path))
    except FileNotFoundError:
        raise UserError(
            f"scenario {str(name)!r} is unknown: there are {', '.join(scenario_names())}"
        ) from None
    except (ValueError, RecursionError, OSError) as error:
        raise UserError(f"{path}: not a scenario: {error}") from None
    return _scenario(path.stem, content)


def _scenario(name: str, content: dict[str, Any]) -> Scenario:
    _known(content, {"about", "budget", "transport", "link", "short", "full", "bars"}, where=name)
    tables = {key: _table(content, key, where=name) for key in ("link", *LENGTHS)}
    for key in ("about", "budget"):
        if not isinstance(content.get(key), str):
            raise UserError(f"{name}: {key} is missing: give a text")
    parse_bitrate(content["budget"], name=f"{name}: budget")
    bars = _table(content, "bars", where=name, needed=False)
    for measure, bar in bars.items():
        if not isinstance(bar, str) or bar.split()[:1] not in (["<="], [">="], ["=="]):
            raise UserError(f"{name}: bar {measure!r} is {bar!r}: write '<= 2', '>= 97' or '== 0'")
    transport = content.get("transport", "tcp")
    if transport not in ("tcp", "udp", "quic"):
        raise UserError(f"{name}: transport {transport!r} is not usable: tcp, udp or quic")
    scenario = Scenario(name, content["about"], content["budget"], bars, transport, tables)
    for length in LENGTHS:
        scenario.script(length)
    return scenario


def _script(name: str, link: Mapping[str, Any], plan: Mapping[str, Any], *, seed: int) -> Script:
    where = f"{name}: link"
    _known(link, {*_STATE, "queue", "burst"}, where=where)
    _known(plan, {"lasts", "steps", "dark", "wave"}, where=name)
    if "rate" not in link:
        raise UserError(f'{where}: rate is missing: write rate = "1Mbps"')
    first = _state(LinkState(1), link, where=where)
    lasts_s = _seconds(plan, "lasts", where=name)
    if not 0 < lasts_s <= _LONGEST_S:
        raise UserError(
            f"{name}: lasts {lasts_s:g} s is not usable: more than 0 and at most {_LONGEST_S:g} s"
        )
    steps = _steps(name, plan, first, lasts_s=lasts_s)
    dark = list(_darkness(name, plan, lasts_s=lasts_s))
    rates = list(_wave(name, plan, lasts_s=lasts_s))
    bursts = _bursts(
        _seconds(link, "burst", where=where, default="0s"), first.loss, lasts_s=lasts_s, seed=seed
    )
    falls, rises = [], []
    for before, after in itertools.pairwise(steps):
        if after.state.rate_bps != before.state.rate_bps:
            (falls if after.state.rate_bps < before.state.rate_bps else rises).append(after.start_s)
    return Script(
        phases=_merged(steps, rates=rates, dark=dark, bursts=bursts, lasts_s=lasts_s),
        lasts_s=lasts_s,
        queue_bytes=_queue(link, where=where),
        falls_s=tuple(falls),
        rises_s=tuple(rises),
    )


_STATE = ("rate", "delay", "jitter", "loss", "reorder")


def _state(before: LinkState, table: Mapping[str, Any], *, where: str) -> LinkState:
    """The state with the changes of the table."""
    changes: dict[str, Any] = {}
    if "rate" in table:
        changes["rate_bps"] = parse_bitrate(str(table["rate"]), name=f"{where}: rate")
    for key in ("delay", "jitter"):
        if key in table:
            changes[f"{key}_s"] = _seconds(table, key, where=where)
            if changes[f"{key}_s"] > _MAX_DELAY_S:
                raise UserError(f"{where}: {key} {table[key]!r} is too much: at most {_MAX_DELAY_S:g} s")
    for key in ("loss", "reorder"):
        if key in table:
            changes[key] = parse_share(str(table[key]), name=f"{where}: {key}")
            if changes[key] > 0.9:
                raise UserError(
                    f"{where}: {key} {table[key]!r} is too much: at most 90%; dark lets nothing pass"
                )
    return replace(before, **changes)


def _steps(name: str, plan: Mapping[str, Any], first: LinkState, *, lasts_s: float) -> list[Phase]:
    phases = [Phase(0.0, first)]
    for number, table in enumerate(_tables_of(plan, "steps", where=name), 1):
        where = f"{name}: step {number}"
        _known(table, {"at", *_STATE}, where=where)
        at_s = _seconds(table, "at", where=where)
        if not phases[-1].start_s < at_s < lasts_s:
            raise UserError(
                f"{where}: at {table['at']!r} is not usable: after the step before, within {lasts_s:g} s"
            )
        phases.append(Phase(at_s, _state(phases[-1].state, table, where=where)))
    return phases


def _darkness(name: str, plan: Mapping[str, Any], *, lasts_s: float) -> Iterator[tuple[float, float]]:
    for number, table in enumerate(_tables_of(plan, "dark", where=name), 1):
        where = f"{name}: dark {number}"
        _known(table, {"at", "lasts", "every"}, where=where)
        at_s, span_s = _seconds(table, "at", where=where), _seconds(table, "lasts", where=where)
        every_s = _seconds(table, "every", where=where, default="0s")
        if not 0 < at_s < at_s + span_s < lasts_s:
            raise UserError(f"{where}: must begin after 0 s and end before {lasts_s:g} s")
        if every_s and every_s <= span_s:
            raise UserError(f"{where}: every {table['every']!r} is not longer than it lasts")
        while at_s + span_s < lasts_s:
            yield at_s, at_s + span_s
            if not every_s:
                break
            at_s += every_s


def _wave(name: str, plan: Mapping[str, Any], *, lasts_s: float) -> Iterator[tuple[float, int]]:
    """A sinusoid from the highest rate down to the lowest and back, in steps."""
    if "wave" not in plan:
        return
    table, where = _table(plan, "wave", where=name), f"{name}: wave"
    _known(table, {"low", "high", "period"}, where=where)
    low, high = (parse_bitrate(str(table.get(key, "")), name=f"{where}: {key}") for key in ("low", "high"))
    period_s = _seconds(table, "period", where=where)
    if not low < high or period_s < 4 * _WAVE_STEP_S:
        raise UserError(f"{where}: low must be below high and the period at least {4 * _WAVE_STEP_S:g} s")
    for number in range(math.ceil(lasts_s / _WAVE_STEP_S)):
        t_s = number * _WAVE_STEP_S
        share = (1 + math.cos(2 * math.pi * (t_s + _WAVE_STEP_S / 2) / period_s)) / 2
        yield t_s, round(low + (high - low) * share)


def _bursts(mean_s: float, loss: float, *, lasts_s: float, seed: int) -> list[tuple[float, float]]:
    """Spans in which all is lost: so long in the mean, and together the share ``loss`` (Gilbert's model in time).

    Starts are spread by a random walk over equal cells, one burst a cell, so that a short script gets its share.
    """
    if not mean_s or not loss:
        return []
    drawn = random.Random(f"bursts-{seed}")
    cell_s, spans = mean_s / loss, []
    for number in range(int(lasts_s / cell_s)):
        span_s = min(mean_s * drawn.uniform(0.5, 1.5), 0.9 * cell_s)
        start_s = number * cell_s + drawn.uniform(0.0, cell_s - span_s)
        spans.append((start_s, start_s + span_s))
    return spans


def _merged(
    steps: list[Phase],
    *,
    rates: list[tuple[float, int]],
    dark: list[tuple[float, float]],
    bursts: list[tuple[float, float]],
    lasts_s: float,
) -> tuple[Phase, ...]:
    """One list of phases out of all that changes; at the end the link is light again."""
    times = {phase.start_s for phase in steps} | {t for t, _ in rates} | {lasts_s}
    times |= {t for span in (*dark, *bursts) for t in span}
    if len(times) > _MAX_PHASES:
        raise UserError(f"the scenario has {len(times)} changes: at most {_MAX_PHASES}")
    phases: list[Phase] = []
    for t_s in sorted(times):
        state = [phase for phase in steps if phase.start_s <= t_s][-1].state
        if rates:
            state = replace(state, rate_bps=rates[min(int(t_s / _WAVE_STEP_S), len(rates) - 1)][1])
        if bursts:
            state = replace(state, loss=1.0 if _within(bursts, t_s) else 0.0)
        if t_s < lasts_s and _within(dark, t_s):
            state = replace(state, dark=True)
        if not phases or phases[-1].state != state:
            phases.append(Phase(t_s, state))
    return tuple(phases)


def _within(spans: Sequence[tuple[float, float]], t_s: float) -> bool:
    return any(start <= t_s < end for start, end in spans)


def _queue(link: Mapping[str, Any], *, where: str) -> int:
    text = str(link.get("queue", "32kB"))
    number = text.removesuffix("kB").strip()
    size = (
        round(1000 * float(number)) if text.endswith("kB") and number.replace(".", "", 1).isdecimal() else 0
    )
    if not 4000 <= size <= _MAX_QUEUE_BYTES:
        raise UserError(f"{where}: queue {text!r} is not usable: write 32kB, at least 4kB and at most 4000kB")
    return size


def _seconds(table: Mapping[str, Any], key: str, *, where: str, default: str | None = None) -> float:
    value = table.get(key, default)
    if value is None:
        raise UserError(f'{where}: {key} is missing: write {key} = "2s"')
    return parse_duration_s(str(value), name=f"{where}: {key}")


def _table(content: Mapping[str, Any], key: str, *, where: str, needed: bool = True) -> dict[str, Any]:
    table = content.get(key, None if needed else {})
    if not isinstance(table, dict):
        raise UserError(f"{where}: [{key}] is missing or not a table")
    return table


def _tables_of(content: Mapping[str, Any], key: str, *, where: str) -> list[dict[str, Any]]:
    tables = content.get(key, [])
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise UserError(f'{where}: {key} must be a list of tables: {key} = [{{ at = "2s" }}]')
    return tables


def _known(table: Mapping[str, Any], known: set[str], *, where: str) -> None:
    for key in table:
        if key not in known:
            raise UserError(f"{where}: {key!r} is not a setting; there are {', '.join(sorted(known))}")
