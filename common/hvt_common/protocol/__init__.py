"""HVT as bytes, without Zenoh: `channels` (the key table), `messages`, `ledger`, `clock_offset`.

What an edge does has its words in `edge_words`: frames, stills, failed parts, auto's decisions.
"""
