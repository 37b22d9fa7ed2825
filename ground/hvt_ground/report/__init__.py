"""The state of a ground as one value (`state`), and its views: `status` for line, summary and table."""
