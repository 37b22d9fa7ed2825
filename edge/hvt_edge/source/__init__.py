"""Sources of frames, one file a kind: others use `opening`, the `contract`, `resample`.

By name they use the `demo`, and `video` and `folder` to read a dataset; `live` closes what cannot be paused.
"""
