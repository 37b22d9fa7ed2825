"""Detectors and classifiers: others use `detect`, `tiles`, `motion`, `classify`, `class_names`, `labels`, `nms`.

`few_found` says when the embedded one finds little, `scores` from where scores count, and if they mean anything.

The room `runtimes` runs a network, `store` gives paths of models.
"""
