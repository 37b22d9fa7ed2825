"""Explains in one sentence why there is no link: others use `diagnose`, `certificate` and `probe` serve it."""
