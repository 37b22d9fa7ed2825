"""Detectors and classifiers: others use `detect`, `tiles`, `classify`, `class_names`, `labels`, `nms`.

`retried` opens a model again after a failure. `view_trust` says when the embedded one does not know a view,
`scale_search` finds the scale at which one promises most objects. `labels` also reads whether a model's scores
are calibrated.

`letterbox` prepares an image as a network's input. The room `runtimes` runs a network, `heads` decodes
its outputs, `store` gives paths of models; the extra `hvt_models` knows more models and merges several.
"""
