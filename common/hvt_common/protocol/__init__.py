"""HVT as bytes, without Zenoh: `channels` (the key table), `messages`, `ledger`, `clock_offset`.

`edge_words` has the texts for an edge's frames, stills, failed parts and decisions of auto.
"""
