"""The Rerun recording and live view: `recorder` writes one session, `live_view` is the viewer that may watch.

`recording_file` is one of the files of a session, `sdk` has what a process sets up before. Who reads a recording
finds in `blueprint` where things are, and in `overlays` how boxes are drawn; `stills` are a room of their own.
"""
