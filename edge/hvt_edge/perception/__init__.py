"""Decoded base and source in, tracks and candidates out: `analyzer`, `candidates`.

`candidates` says too where a still is cut and what the base lost there. `shadow` measures what the ground would miss,
and how far the ground's own count differs; by that `levers` decides what ``auto`` sends. `frame_ring` keeps source
frames. `cpu_budget` decides what of this runs when the processor is scarce.
"""
