"""Pure functions on the labels and the lists of the ground: `class_score`, `tracking_score` and others."""
