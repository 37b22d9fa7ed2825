"""The base stream: `stage` decides whether a frame is coded, and by which `encoder`: `x265` as a rule.

`encoders` has others; `passthrough` is the stage without one. `rate_model` decides on frames and preset,
`reconfigure` on rates; it opens the encoder anew with a keyframe.
"""
