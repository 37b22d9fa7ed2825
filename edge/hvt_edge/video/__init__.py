"""The base stream: `stage` decides whether a frame is coded, and by `x265`, opened by `encoder_settings`.

`encoders` has others in place of x265; `passthrough` is the stage without one. `rate_model` says which frames,
`share` at which rate; `reconfigure` changes all that with a keyframe.
"""
