"""What an edge kept while its link was away: put together, delivered, shown at its own time."""

from __future__ import annotations

from hvt_ground.backlog.assembly import PastAssembly, PastContent, PastKey, StoredStill, past_content

__all__ = ["PastAssembly", "PastContent", "PastKey", "StoredStill", "past_content"]
