"""Decoded base in, tracks out: a `pipeline` for each session, the `worker` it runs in, the `models` they share.

`history` is what was decoded lately; `fusion` makes one list of all tracks, `stills` refines them,
and `guesses` are those that are more likely nothing.
Sessions share the detector, which has a `detector_thread`.
"""
