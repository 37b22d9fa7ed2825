"""What every process needs: `clock`, `process` (signals, priority, allocator), `reporting`, `statistics`."""
