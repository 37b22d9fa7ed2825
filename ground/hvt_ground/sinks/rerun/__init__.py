"""The Rerun recording and live view: `recorder` writes one session, `live_view` is the viewer that may watch.

`recording_file` is one of the files of a session, `sdk` has what a process sets up before.
"""
