"""HVT over Zenoh: `session` opens it as `zenoh_config` says, `inbox` queues what arrives, `flood` notices too much.

`doctor` explains why there is no link, `duplicate_edge` refuses a second edge of one id, `rights` are those of a key;
`reach` looks for the other side before a start.
"""
