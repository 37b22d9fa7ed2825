"""Where events go: recordings, live views, tables; each behind a queue, so that its failure is its own."""

from __future__ import annotations

from hvt_ground.sinks.contract import Sink, SinkWriter
from hvt_ground.sinks.queued import Outputs, QueuedSink

__all__ = ["Outputs", "QueuedSink", "Sink", "SinkWriter"]
