"""Asking edges for more: a still, a keyframe, another budget or method. For people and for programs."""

from __future__ import annotations

from hvt_ground.control.api import EdgeClient, EdgeTrack, RefusedError, RemoteEdge, RequestedStill

__all__ = ["EdgeClient", "EdgeTrack", "RefusedError", "RemoteEdge", "RequestedStill"]
