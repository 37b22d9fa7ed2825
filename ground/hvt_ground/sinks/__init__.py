"""Where events go: recordings, live views, tables."""
