"""Reads foreign exports: `first_steps` on their pixels, the `forms` of their numbers, and `ir`, OpenVINO's files."""
