"""HEVC decoding, still codecs, and what the base shows of a crop."""
