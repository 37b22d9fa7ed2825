"""What comes after the recording: an `index` of a folder, `exports` for other programs, `replay` with other models.

`reading` opens recordings for the others. Nothing of the ground imports one.
"""
