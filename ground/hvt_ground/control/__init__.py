"""Asking edges for more: a still, a keyframe, another budget or method. For people and for programs.

Programs use what is listed here; `command` gives people the same on the command line.
"""

from __future__ import annotations

from hvt_ground.control.api import EdgeClient, EdgeTrack, RefusedError, RemoteEdge, RequestedStill

__all__ = ["EdgeClient", "EdgeTrack", "RefusedError", "RemoteEdge", "RequestedStill"]
