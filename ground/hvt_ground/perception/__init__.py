"""Decoded base in, tracks out: `session` makes a `pipeline` for each, a `worker` runs it, all share the `models`.

`history` keeps the last decoded pictures; `fusion` makes one list of all tracks, `stills` refines them,
and `guesses` finds those that are more likely nothing.
Sessions share the detector, which has a thread (`models`).
"""
