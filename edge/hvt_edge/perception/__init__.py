"""Decoded base and source in, tracks and candidates out: `analyzer`, `candidates`.

`candidates` also cuts stills and measures the base's loss there. `shadow` measures the ground's missed detections,
and how far the ground's own count differs; from that `auto` decides whether ``auto`` sends tracks and stills.
`frame_ring` stores source frames. `cpu_budget` decides which parts run when the processor is scarce.
"""
