"""What an edge kept while its link was away: put together, delivered, shown at its own time."""

from __future__ import annotations

from hvt_ground.backlog.assembly import (
    BacklogAssembly,
    BacklogContent,
    BacklogKey,
    StoredStill,
    backlog_content,
)

__all__ = ["BacklogAssembly", "BacklogContent", "BacklogKey", "StoredStill", "backlog_content"]
