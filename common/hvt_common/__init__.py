"""Shared by edge and ground: values, settings, wire protocol, transport, video, inference and tracking."""

import os

__all__ = ["__version__"]

__version__ = "0.1.0"

# Onnxruntime's wheels for Linux and macOS (from 1.29 on) report to their maker: an upload over the very link that HVT
# counts the bits of, an identifier and a growing file in the home folder. It is decided when onnxruntime is imported.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
# NumPy and OpenCV each bring OpenBLAS with a thread for each processor, for matrices that nothing here has. It is
# decided when they are imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
