"""Where on the ground things are.

`locate` is for sessions; `camera`, `footprint`, `trail`, `surface` and `terrain` are for others.
"""
