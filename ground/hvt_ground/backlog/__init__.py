"""What an edge stored while its link was down: put together, delivered, shown at its own time."""

from __future__ import annotations

from hvt_ground.backlog.assembly import (
    BacklogAssembly,
    BacklogContent,
    backlog_content,
)

__all__ = ["BacklogAssembly", "BacklogContent", "backlog_content"]
