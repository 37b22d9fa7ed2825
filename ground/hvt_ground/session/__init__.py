"""From the link of one edge to its sessions: `subscribe` hears it, `edge_sessions` begins and ends each `session`.

`receiver_report` is what the edge is told.
"""
