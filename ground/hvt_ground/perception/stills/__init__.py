"""A still at the ground: `stage` takes it through `decode`, `classify` and `refine`, which finds its track.

`vocabulary` says what a classifier's words mean for a track, `posterior` when it is sure; `composite` lays them
over the base picture.
"""
