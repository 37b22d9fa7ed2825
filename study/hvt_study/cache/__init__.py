"""Keeps what was computed once on disk: flights, detections, named by the content and code that decide them."""
