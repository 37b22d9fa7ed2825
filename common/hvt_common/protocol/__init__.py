"""HVT as bytes, without Zenoh: `channels` (the key table), `messages`, `ledger`, `clock_offset`.

What an edge does has its words in `frame_account` (frames) and `edge_words` (stills, failed parts, auto's decisions).
"""
