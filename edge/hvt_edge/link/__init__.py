"""The edge's end of the link: `transmitter` sends as `budget`, `pacer`, `rate_control` allow, `publisher` is Zenoh.

`envelope` is a still with its header, `tracks_channel` what is told of tracks. `feedback` takes in what grounds
report, `receivers` judges which of them steers, `still_readers` knows what they decode.
"""
