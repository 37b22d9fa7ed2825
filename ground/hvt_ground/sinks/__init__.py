"""Sinks of events: recordings, live views, tables; each behind a queue, so that its failure is its own.

Beside what is listed here there are `queued`, `event_tables`, `palette` (colours),
`line_file` and the room `rerun`. Extras bring others (`hvt_ground.extras`).
"""

from __future__ import annotations

from hvt_ground.sinks.queued import Outputs, QueuedSink, Receipt, Sink, SinkWriter

__all__ = ["Outputs", "QueuedSink", "Receipt", "Sink", "SinkWriter"]
