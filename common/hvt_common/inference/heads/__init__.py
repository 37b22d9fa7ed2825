"""What the outputs of detector networks mean: others use `choose`, `contract`.

`trial` holds what a network answered to a few pictures, `kinds` the heads that are known, `decode` how their numbers
become boxes.
"""
