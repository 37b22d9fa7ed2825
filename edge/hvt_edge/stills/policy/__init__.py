"""Scheduling policies: which tracks deserve a still at this step. `registry` has every method by name.

`base` says what a method is (`Step` in, `Request` out) and what a still will take; `m6` is ours, `selectors` the
pilot's, `paper` the paper's.
"""
