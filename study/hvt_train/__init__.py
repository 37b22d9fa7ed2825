"""How the embedded models are trained: drawn pictures in, ONNX files out. Needs PyTorch; see ``docs/models.md``.

``python -m hvt_train detector|classifier|all`` trains, ``… eval`` measures the result.
"""
