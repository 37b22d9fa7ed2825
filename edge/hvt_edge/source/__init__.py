"""Sources of frames, one file a kind: other rooms use `opening`, the `contract`, `resample`.

By name they use `video` and `folder` to read a dataset; `live` closes a source that cannot be paused,
`stream` gives its packets, `decoding` opens and times them.
"""
