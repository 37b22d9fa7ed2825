"""Keeps on disk what was computed once, named by content and code: `ResultCache`, `CachedDetector`, `code_digest`."""
