"""From the link of one edge to its sessions.

`subscribe` sorts what comes by edge, each of which is an `edge_port`; `edge_sessions` begins and ends each `session`.
`receiver_report` is what the edge is told.
"""
