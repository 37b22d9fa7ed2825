"""The Rerun recording and live view: `recorder` writes one session, `live_view` is the viewer that may watch.

`sdk` has what a process sets up before.
"""
