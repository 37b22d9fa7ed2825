"""HVT over Zenoh: `session` opens it as `zenoh_config` says, `inbox` queues what arrives and notices too much.

`link_doctor` is the door for who explains why there is no link, and reads the rights of a key.
"""
