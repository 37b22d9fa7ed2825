"""One frame after the other: `realtime`, or `lockstep` with media time; `counts` of frames, `cpu` they would take.

`pose` says where the camera was, and has the door to the extras that know it.
"""
