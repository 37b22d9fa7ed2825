"""Sinks of events: recordings, live views, tables; each behind a queue, so that its failure is its own.

A new one satisfies `SinkWriter` (in `queued`); with settings of its own it is an `hvt_ground.extras.Extra`.
Here are `palette` (colours) and the room `rerun`.
"""

from __future__ import annotations

from hvt_ground.sinks.queued import Outputs, QueuedSink, Receipt, Sink, SinkWriter

__all__ = ["Outputs", "QueuedSink", "Receipt", "Sink", "SinkWriter"]
