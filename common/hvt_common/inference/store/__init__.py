"""Models by name: those of the package, those that ``hvt-models`` fetched or was given, and plain files."""

from hvt_common.inference.store.resolve import resolve_model

__all__ = ["resolve_model"]
