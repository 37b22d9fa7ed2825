"""HVT as bytes, without Zenoh: `channels` (the key table), `messages`, `ledger`, `clock_offset`.

What becomes of frames and stills has its words in `frame_account` and `still_words`.
"""
