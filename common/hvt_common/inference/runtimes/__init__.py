"""Runs a network: `model` opens a file, `providers` names who runs it.

`onnx_file` and `ir_file` read what is in a file, `plug_in` takes detectors of other packages.
"""
