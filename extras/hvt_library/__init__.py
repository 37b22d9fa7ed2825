"""Sides as parts of another program, by the entry point `hvt.library`; see docs/library.md.

`edge` takes its frames, `ground` gives it events, `program` runs them.
"""
