"""Metrics of the study: pure functions on what the ground showed, frame by frame, and what was there."""
