"""Decoded base and source in, tracks and candidates out: `analyzer`, `guarded_detector`, `candidates`.

`shadow` measures what the ground would miss, `detected` how far the ground's own count differs. `crop` says where a
still is cut, `base_loss` what the base lost there; `frame_ring` keeps source frames, `skipped_units` what is not
decoded yet.
"""
