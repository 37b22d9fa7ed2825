"""Decodes coded video to pictures as a player shows them; the rest of `source` chooses the video and its pace.

`container` opens files and streams, `timeline` mends time stamps, `pictures` turns decoded frames into upright BGR of
square pixels, and sixteen bits into eight.
"""
