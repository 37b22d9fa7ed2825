"""Scheduling policies: which tracks deserve a still at this step. `registry` has every method by name.

`base` defines a method (`Step` in, `Request` out), the expected cost of a still, and which requests share one; `m6`
is ours, `paper` the paper's and the pilot's.
"""
