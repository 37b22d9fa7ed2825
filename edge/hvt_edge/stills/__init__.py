"""ROI stills: which candidate gets one, its crop, its coding, and its life until it is acknowledged.

A still's path: `stage` reports tracks and hands them to `scheduler`, which queries `policy`, joins neighbours, crops
and codes (`maker`) within the budget, and puts the still in the `outbox`; `stage` hands it to the link's
transmitter, or to the backlog while the link is away. `on_demand` serves requests of grounds, `requested_coding`
codes their stills or gives the reason why not. `worker` has the threads of all this in real time.
"""
