"""Encoders beside x265: `qualification` tries one before a flight.

`hardware` has FFmpeg's encoders. `passthrough` has none: it measures a camera that makes HEVC itself, before the
flight and in it, and ensures room for its units.
"""
