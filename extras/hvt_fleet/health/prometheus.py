"""A state as Prometheus reads it: names in base units, one series an edge."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TypeVar

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

Gauge, Counter = GaugeMetricFamily, CounterMetricFamily

_State = TypeVar("_State")
Table = Mapping[str, tuple[str, Callable[[_State], float | None]]]
"""Metrics by name: the help text, and the value as a function of a state; None is left out."""


def exposition(metrics: Iterable[Metric]) -> bytes:
    """The text format, version 0.0.4."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Made(metrics))
    return generate_latest(registry)


def of_table(
    table: Table[_State],
    family_of: type[GaugeMetricFamily | CounterMetricFamily],
    states: Iterable[tuple[str, _State]],
) -> Iterator[Metric]:
    """One metric a row, with a value for each state by the edge's name."""
    by_edge = list(states)
    for name, (says, value_of) in table.items():
        family = family_of(name, says, labels=("edge",))
        for edge, state in by_edge:
            value = value_of(state)
            if value is not None:
                family.add_metric((edge,), value)
        yield family


def seconds(ms: float | None) -> float | None:
    return None if ms is None else ms / 1000


class _Made(Collector):
    def __init__(self, metrics: Iterable[Metric]) -> None:
        self._metrics = metrics

    def collect(self) -> Iterable[Metric]:
        return self._metrics
