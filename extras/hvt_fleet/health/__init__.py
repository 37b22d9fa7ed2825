"""For who watches an edge or a ground: `server` answers programs, `edge_status` and `ground_status` are for people.

`edge_metrics` and `ground_metrics` put a state into the words of `prometheus`; `status_command` prints one.
"""
