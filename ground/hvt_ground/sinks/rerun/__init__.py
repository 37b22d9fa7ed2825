"""The Rerun recording and live view: `recorder` writes one session, `live_view` is the viewer that may watch.

`rrd_file` is one of the files of a session, `sdk` sets the process up. A reader of
recordings finds the places of entities in `blueprint`, the drawing of boxes in `overlays`, the row of a pose in
`map_rows`, and the words and the picture of a still in `stills`.
"""
