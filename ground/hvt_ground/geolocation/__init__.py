"""Where on the ground things are.

`locate` is for sessions; `camera`, `footprint`, `trail`, `surface`, `terrain` and `elevation` are for others.
"""
