"""Decoded base in, tracks out: the pipeline, and the worker that it runs in."""
