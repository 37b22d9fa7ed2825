"""Pure functions on what was there and what the ground showed: `class_score`, `tracking_score` and others."""
