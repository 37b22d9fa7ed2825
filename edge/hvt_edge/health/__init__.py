"""How an edge is: `state` once a second as one value, by the `heartbeat` of its loop, told as `metrics`, or to a
`watch` from another shell.

`system` reads what the machine tells of itself.
"""
