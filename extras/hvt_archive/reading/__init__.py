"""Recordings read back: `recorded` opens the files of a session, what is large stays on disk."""
