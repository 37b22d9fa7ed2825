"""What every process needs: `clock`, `failures`, `process` (signals, priority), `reporting`, `statistics`."""
