"""HVT over Zenoh: `session` opens it, `inbox` queues what arrives, `doctor` explains why there is no link."""
