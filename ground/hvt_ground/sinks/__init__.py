"""Sinks of events: recordings, live views, tables; each behind a queue, so that its failure is its own.

Beside what is listed here there are `event_tables`, `palette` (colours),
`line_file`, the `contract` and the room `rerun`. Extras bring others (`hvt_ground.extras`).
"""

from __future__ import annotations

from hvt_ground.sinks.contract import Sink, SinkWriter
from hvt_ground.sinks.queued import Outputs, QueuedSink, Receipt

__all__ = ["Outputs", "QueuedSink", "Receipt", "Sink", "SinkWriter"]
