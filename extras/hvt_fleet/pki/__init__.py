"""Keys and rights of a fleet: a small certificate authority, and Zenoh configurations that let nobody do more.

Others use `command`, which is ``hvt-ground keys``, `roster`, who belongs to a fleet, and the `authority` itself.
"""
