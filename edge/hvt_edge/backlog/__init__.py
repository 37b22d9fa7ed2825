"""What the edge keeps on disk while its link is away, and how it comes back.

One stage a file: `outage` says when the link is away, `backlog` is what the frame loop asks, `folder` is the disk
(`entry` one object in it, `segment` one stretch of video, `open_segment` the one being written), `backfill` cuts what
is kept into pieces. `worker` is the thread of these, `intake` what it is given, `outgoing` the thread that sends.
"""
