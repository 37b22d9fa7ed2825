"""Stills in a recording: pairs in a gallery, patches on the picture.

Others use `rows`, `gallery`, and the words and pictures of one still, `pairs`.
"""
