"""HVT as bytes, without Zenoh: `channels` (the key table), `messages`, `ledger`, `clock_offset`; what becomes of frames
and stills, and its words: `frame_account`, `still_words`."""
