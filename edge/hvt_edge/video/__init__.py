"""The base stream: `stage` decides whether a frame is coded, and `encoder` opens the encoder, `x265` as a rule.

`qualification` tries others before a flight. `rate_model` chooses frames and preset, `reconfigure` sets rates and
opens the encoder anew, with a keyframe.
"""
