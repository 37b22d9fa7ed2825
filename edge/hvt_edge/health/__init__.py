"""The state of an edge: `state` once a second as one value, by the heartbeat of its loop.

`metrics` and `watch` tell it to programs and to people in another shell.
"""
