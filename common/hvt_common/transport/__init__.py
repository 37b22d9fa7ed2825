"""HVT over Zenoh: `session` opens it as `zenoh_config` says, `inbox` queues arriving messages and notices floods.

`stale_sockets` ends sockets that a dark line left behind. `link_doctor` is the door for an extra that explains why
there is no link, and reads the rights of a key.
"""
