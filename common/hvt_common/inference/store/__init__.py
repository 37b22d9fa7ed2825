"""Gives the path of a model by name: of the package, fetched or added by ``hvt-models``, or a plain file.

Others use what is listed here; ``hvt-models`` also opens the `store` itself and shows what its `manifest` says.
"""

from hvt_common.inference.store.resolve import (
    EMBEDDED_CLASSIFIER,
    EMBEDDED_DETECTOR,
    embedded_models,
    known_classes,
    model_names,
    resolve_model,
)

__all__ = [
    "EMBEDDED_CLASSIFIER",
    "EMBEDDED_DETECTOR",
    "embedded_models",
    "known_classes",
    "model_names",
    "resolve_model",
]
