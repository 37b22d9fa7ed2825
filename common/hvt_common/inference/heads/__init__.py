"""Heads read the outputs of detector networks: others use `choose`, `contract`; the extra `hvt_models` has most.

`trial` holds what a network answered to a few pictures, `kind` the marks of a head, `decode` how its numbers become
boxes.
"""
