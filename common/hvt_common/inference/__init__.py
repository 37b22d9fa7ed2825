"""Detectors and classifiers: others use `detect`, `tiles`, `motion`, `classify`, `class_names`, `labels`, `nms`,
`scores`.

The room `runtimes` runs a network, `store` gives paths of models.
"""
