"""Runs a network: `model` opens an ONNX file, `onnx_file` reads what is in one, `providers` names who runs it."""
