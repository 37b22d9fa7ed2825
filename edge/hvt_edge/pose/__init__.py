"""The pose of the camera: fixed, from a file beside the clip, or from an autopilot.

A source is opened by `opening`, read by `files` or a `table`; `contract` says what it is, and the
wiring builds the `stage`.
"""
