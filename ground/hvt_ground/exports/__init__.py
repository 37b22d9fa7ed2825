"""What leaves a recording for other programs: `command`, `recorded` (reads it), and one file a kind."""
