"""Networks, losses and the training loops of detector and classifier, and their export to ONNX."""
