"""Coded video to pictures as a player shows them; the rest of `source` says whose and when.

`container` opens files and streams, `timeline` mends time stamps, `pictures` makes upright BGR of square pixels of
what is decoded, and eight bits of sixteen.
"""
