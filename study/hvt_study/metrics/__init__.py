"""Pure functions on what was there and what the ground showed, by frame: `class_score`, `tracking_score` and others."""
