"""Runs a network: `model` opens a file, `providers` names who runs it.

`model_file` reads a file, `first_steps` its scaling of pixels, `plug_in` takes detectors of other packages.
"""
