"""The base stream: `stage` takes a frame through `frame_decision` and `x265`, opened by `encoder_settings`.

`encoders` has others in place of x265; `passthrough` is the stage without one. `frame_skip` says
which frames, `regions` where finer, `rate_model` and `share` at which rate, `preset` with how much time;
`reconfigure` changes all that with a keyframe.
"""
