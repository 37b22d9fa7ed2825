"""Where events go: recordings, live views, tables; each behind a queue, so that its failure is its own.

Beside what is listed here there are `mcap_file`, `message_log`, `still_files`, `timing`, `tracks_table`, `palette`
(colours), `decodable` and the rooms `cot`, `rerun` and `transport_stream`.
"""

from __future__ import annotations

from hvt_ground.sinks.contract import Sink, SinkWriter
from hvt_ground.sinks.queued import Outputs, QueuedSink, Receipt

__all__ = ["Outputs", "QueuedSink", "Receipt", "Sink", "SinkWriter"]
