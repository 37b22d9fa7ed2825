"""Networks, losses, training loops of detector and classifier, and `export_onnx`."""
