"""One frame after the other: `realtime`, or `lockstep` with media time; `counts` counts frames and processor time.

`pose` defines a source of camera poses, and opens those of extras.
"""
