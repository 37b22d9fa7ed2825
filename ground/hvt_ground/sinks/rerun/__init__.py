"""The Rerun recording and live view: `recorder` writes one session, `live_view` is the viewer that may watch.

`recording_file` is one of the files of a session, `sdk` has what a process sets up before. Who reads a recording
finds in `blueprint` where things are, in `overlays` how boxes are drawn, in `map_rows` what a pose's row says, in
`rrd_file` whose a file is, in `readable` what of a damaged one can be read, and in `stills` the words and the picture
of a still.
"""
