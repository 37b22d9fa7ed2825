"""HVT as bytes, without Zenoh: the channel table, the messages, the ledger that counts them."""
