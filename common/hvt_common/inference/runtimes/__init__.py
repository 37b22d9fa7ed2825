"""What runs a network: `model` opens an ONNX file; settings take the names of providers from `providers`."""
