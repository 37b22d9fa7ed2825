"""Encoders beside x265: `registry` opens one by its name, `qualification` tries it at the start of a flight.

The `contract` is x265's own, and checks every unit of others. `hardware` has those of FFmpeg, a row of `registry`
each. `passthrough` has none: it measures a camera that makes HEVC itself, and `camera_rates` sees
that its units have room.
"""
