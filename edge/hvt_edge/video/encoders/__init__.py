"""Encoders beside x265: `registry` opens one by its name, `qualification` tries it at the start of a flight.

The `contract` is x265's own. `hardware` has those of FFmpeg, a row of `hardware_rows` each; every unit but
x265's passes `checked`. `passthrough` has none: it measures a camera that makes HEVC itself, and `camera_rates` sees
that its units have room.
"""
