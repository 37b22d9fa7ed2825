"""For every process: `clock`, `failures`, `log`, `plug_ins`, `process` (signals), `reporting`, `statistics`.

`health_server` answers who watches one, `prometheus` in the words of metrics, `status_command` in a table;
`host_names` are those under which a browser may ask.
"""
