"""What changes in flight, with one owner each: `point` (rates, method) and `keyframes` (requests from any thread)."""
