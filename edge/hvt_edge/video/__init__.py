"""The base stream: `stage` decides whether a frame is coded, and `encoder` opens the encoder, `x265` as a rule.

`hardware` has FFmpeg's others, which `qualification` tries before a flight; `passthrough` is the stage without an
encoder. `rate_model` chooses frames and preset, `reconfigure` sets rates; it opens the encoder anew with a keyframe.
"""
