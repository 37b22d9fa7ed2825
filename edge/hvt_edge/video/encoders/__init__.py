"""Encoders beside x265: `registry` has their contract and names, `qualification` tries one before a flight.

`hardware` has those of FFmpeg, a row of `registry` each. `passthrough` has none: it measures a camera that makes HEVC
itself, before the flight and in it, and sees that its units have room.
"""
