"""For every process: `clock`, `failures`, `log`, `plug_ins`, `process` (signals), `reporting`, `statistics`.

`health` is the door for who answers those that watch one, `host_names` are those under which a browser may ask.
"""
