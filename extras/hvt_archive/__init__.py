"""Work on recordings: an `index` of a folder, `exports` for other programs, `replay` with other models.

`reading` opens recordings for the others, `joined` makes one of several, `screenshot` a picture, `viewer` a live
view, by the settings of `viewing`; `local_copy` is the edge's own. Nothing of the ground imports one.
"""
