"""``--encoder passthrough``: `stream` and `sources` read a camera's HEVC, `camera` checks it, `stage` sends it."""
