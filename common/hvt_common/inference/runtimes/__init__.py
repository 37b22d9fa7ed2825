"""Runs a network: `model` opens a file, `providers` names who runs it.

`model_file` reads a file, `plug_in` takes detectors of other packages.
"""
