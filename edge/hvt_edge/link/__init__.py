"""The edge's end of the link: `transmitter` sends as `budget`, `pacer`, `rate_control` allow, `publisher` is Zenoh.

`stills` has a still with its header, and what grounds decode.
`tracks_channel` is what is told of tracks. `feedback` takes in what grounds report, and judges which of them steers.
"""
