"""From the link of one edge to its sessions.

`subscribe` sorts messages by edge; an `edge_port` is one of them, with the way to query it and to report to it.
`edge_sessions` begins and ends each `session`.
"""
