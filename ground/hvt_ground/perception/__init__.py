"""Decoded base in, tracks out: a `Pipeline` for each session, the worker it runs in, the `Models` they share."""
