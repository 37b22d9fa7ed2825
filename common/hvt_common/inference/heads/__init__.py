"""Heads read the outputs of detector networks: others use `choose`, `contract`; the extra `hvt_models` has most.

`choose` holds what a network answered to a few pictures, and the marks of a head and of the embedded detector's in
it, `contract` how its numbers become boxes.
"""
