"""Explains in one sentence why there is no link: `diagnose`, by `certificate`, `probe` and `strangers`.

`reach` looks once, before a flight.
"""
