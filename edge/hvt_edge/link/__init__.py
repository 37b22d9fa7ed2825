"""The edge's end of the link: `transmitter` sends as `budget`, `pacer`, `rate_control` allow, `publisher` is Zenoh.

`stills` holds a still with its header, and the codecs that grounds decode.
`tracks_channel` sends tracks. `feedback` receives the grounds' reports, and decides which ground steers.
"""
