"""What every process needs: clock, stopping, priorities, allocator, status line, latency statistics."""
