"""Messages of the link, put in order and counted; pure but for `group`.

`packets` are messages once parsed; `reassemble` makes them decodable, `statistics` says what is missing,
`sequence_window` remembers numbers, `other_sessions` keeps strangers apart. `group` shares edges among grounds,
and `capture_clock` has capture times by this ground's clock.
"""
