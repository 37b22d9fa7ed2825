"""What every process needs: `clock`, `failures`, `log`, `plug_ins`, `process` (signals), `reporting`, `statistics`.

`health_server` answers who watches one, `prometheus` in the words of metrics, `status_command` in a table.
`checkup` is what a program checks before its start.
"""
