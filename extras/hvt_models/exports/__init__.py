"""Reads foreign exports: `first_steps` on their pixels, and the `forms` of their numbers."""
