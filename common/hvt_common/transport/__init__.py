"""HVT over Zenoh: `session` opens it as `zenoh_config` says, `inbox` queues what arrives, `flood` notices too much.

`link_doctor` is the door for who explains why there is no link, `rights` are those of a key.
"""
