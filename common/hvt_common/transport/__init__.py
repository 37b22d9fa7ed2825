"""HVT over Zenoh: `session` opens it as `zenoh_config` says, `inbox` queues what arrives and notices too much.

`stale_sockets` ends what a dark line left behind. `link_doctor` is the door for who explains why there is no link,
and reads the rights of a key.
"""
