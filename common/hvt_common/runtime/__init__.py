"""For every process: `clock`, `failures`, `log`, `plug_ins`, `process` (signals), `reporting`, `statistics`.

`host_names` are those under which a browser may ask for one.
"""
