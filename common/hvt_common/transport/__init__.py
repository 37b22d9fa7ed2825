"""Zenoh: session, configuration, the queue between its callbacks and our threads."""
