"""Scheduling policies: which tracks deserve a still at this step. `registry` has every method by name.

`base` says what a method is (`Step` in, `Request` out), what a still will take, and which requests share one; `m6` is
ours, `selectors` the pilot's, `paper` the paper's.
"""
