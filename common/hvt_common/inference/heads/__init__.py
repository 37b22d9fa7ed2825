"""Heads read the outputs of detector networks: others use `choose`, `contract`.

`trial` holds what a network answered to a few pictures, `kinds` the heads that are known, `decode` how their numbers
become boxes.
"""
