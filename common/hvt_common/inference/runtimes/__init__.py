"""Runs a network: `model` opens a file, `providers` names who runs it.

`model_file` reads what is in a file, `first_steps` how it scales pixels, `plug_in` takes detectors of other packages.
"""
