"""Metrics of the study: pure functions on what the ground showed, tick by tick, and what was there."""
