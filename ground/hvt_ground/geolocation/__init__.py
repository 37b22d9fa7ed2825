"""Places of objects on the ground.

`locate` is for sessions; `camera`, `footprint`, `trail`, `surface`, `terrain` and `elevation` are for others.
"""
