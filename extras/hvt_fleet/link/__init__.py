"""Explains in one sentence why there is no link: `diagnose`, by `certificate`, `probe` and `strangers`.

`stale_sockets` ends sockets that a dark line left behind. `duplicate_edge` finds another edge of one id;
`certificate` reads the keys and the rights of our own file, and `group` shares edges among grounds.
"""
