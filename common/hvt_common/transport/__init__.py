"""HVT over Zenoh: `session` opens it as `zenoh_config` says, `inbox` queues arriving messages and notices floods.

`own_sockets` looks at the sockets of this process. `link_doctor` is the door for an extra that explains why there is
no link, mends one, and reads the rights of a key.
"""
