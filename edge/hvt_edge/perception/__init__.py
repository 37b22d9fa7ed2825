"""Decoded base and source in, tracks and candidates out: `analyzer`, `candidates`, `frame_ring` (source frames)."""
