"""What both ends of an HVT link agree on: values, link (Zenoh, bytes) and vision (pixels)."""

__all__ = ["__version__"]

__version__ = "0.1.0"
