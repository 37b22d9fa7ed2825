"""Pixels and their codings: `hevc` (decoder), `still_codecs`, `base_crop` (what the base shows of a crop)."""
