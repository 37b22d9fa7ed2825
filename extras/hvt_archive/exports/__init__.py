"""Writes recordings for other programs: `command`, `video`, and one file a kind.

Extras bring further kinds (`hvt_ground.extras`).
"""
