"""Detectors and classifiers: others use `detect`, `tiles`, `classify`, `class_names`, and `store` for paths."""
