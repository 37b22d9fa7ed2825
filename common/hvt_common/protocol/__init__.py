"""HVT as bytes, without Zenoh: `channels` (the key table), `messages`, `ledger`, `clock_offset`."""
