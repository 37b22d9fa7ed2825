"""Encoders beside x265: `qualification` tries one before a flight.

`hardware` has those of FFmpeg. `passthrough` has none: it measures a camera that makes HEVC itself, before the flight
and in it, and sees that its units have room.
"""
