"""One frame after the other: `realtime`, or `lockstep` with media time; `counts` has frames and processors.

`pose` says where the camera was, and has the door to the extras that know it.
"""
