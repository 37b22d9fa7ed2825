"""Detectors and classifiers: others use `detect`, `tiles`, `motion`, `classify`, `class_names`, `labels`, `nms`.

`scores` says from where a detector's scores count, and whether they are probabilities.

The room `runtimes` runs a network, `store` gives paths of models.
"""
