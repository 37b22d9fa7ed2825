"""Recordings read back: `recorded` opens the files of a session, `readable` a damaged one; much stays on disk."""
