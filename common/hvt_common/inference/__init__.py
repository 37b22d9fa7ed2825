"""Detectors and classifiers: others use `detect`, `tiles`, `motion`, `classify`, `class_names`, `labels`, `nms`.

`few_found` says when the embedded one finds little. The room `runtimes` runs a network, `store` gives their paths.
"""
