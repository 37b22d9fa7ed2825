"""Explains in one sentence why there is no link: `diagnose`, by `certificate`, `probe` and `strangers`.

`duplicate_edge` finds another edge of one id.
"""
