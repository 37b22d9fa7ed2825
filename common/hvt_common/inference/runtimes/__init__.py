"""What runs a network: ONNX Runtime and its providers, OpenVINO, the bounds on a model file."""
