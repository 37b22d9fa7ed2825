"""Detectors and classifiers: others use `detect`, `tiles`, `motion`, `classify`, `class_names`, `labels`, `nms`.

`few_found` hints that a detector is out of its depth. `runtimes` runs a network, `store` gives paths of models.
"""
