"""Detectors and classifiers, and what runs them. The store gives paths, the models open them."""
