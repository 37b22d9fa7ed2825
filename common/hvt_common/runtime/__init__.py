"""What every process needs: `clock`, `failures`, `process` (signals), `reporting`, `statistics`, `plug_ins`."""
