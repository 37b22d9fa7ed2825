"""Detectors beyond a single network: `motion` needs no weights, `ensemble` merges several (``A+B``)."""
