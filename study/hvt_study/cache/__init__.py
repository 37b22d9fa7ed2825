"""Keeps computed results on disk, named by content and code: `ResultCache`, `CachedDetector`, `code_digest`."""
