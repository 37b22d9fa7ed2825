"""Coded video to pictures as a player shows them; the rest of `source` says whose and when.

`container` opens files and streams, `timeline` mends time stamps, `pictures` makes upright BGR of square pixels of
what is decoded, `levels` brings 16 bits of heat to 8, `condition` tells of black and frozen pictures, `notes` keeps
what was decided.
"""
