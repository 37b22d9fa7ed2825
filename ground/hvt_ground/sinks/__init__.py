"""Where events go: recordings, live views, tables; each behind a queue, so that its failure is its own.

Beside what is listed here there are `mcap_file`, `message_log`, `still_files`, `timing`, `tracks_table`, `palette`
(colours) and the room `rerun`.
"""

from __future__ import annotations

from hvt_ground.sinks.contract import Sink, SinkWriter
from hvt_ground.sinks.queued import Outputs, QueuedSink

__all__ = ["Outputs", "QueuedSink", "Sink", "SinkWriter"]
