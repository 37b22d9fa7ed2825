"""ROI stills: which candidate gets one, its crop, its coding, and its life until it is acknowledged.

A still's walk: `stage` reports tracks and hands them to `scheduler`, which asks `policy`, joins neighbours, crops
and codes (`maker`) what the budget allows, and puts it in the `outbox`, and `stage` hands it to the link's
transmitter, or to the backlog while the link is away. `on_demand` serves what grounds request, `requested_coding`
codes it or says why not. `worker` is the thread of all this in real time.
"""
