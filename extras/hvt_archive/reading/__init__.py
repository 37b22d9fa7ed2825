"""Recordings read back: `recorded` opens the files of a session; large parts stay on disk."""
