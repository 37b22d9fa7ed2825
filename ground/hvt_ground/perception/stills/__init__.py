"""A still at the ground: `stage` takes it through `decode`, `classify` and `refine`, which finds its track.

`vocabulary` maps a classifier's words to classes of tracks, `posterior` when it is sure.
"""
