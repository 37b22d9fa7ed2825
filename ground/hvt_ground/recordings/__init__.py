"""Recordings on disk over months: files that follow each other, an index of them, and what is removed when.

`session_files` writes those of one session and says of each what a `row` has, `folder` keeps the index of a folder
and removes what is due, `retention` says what is, `command` lists and finds, `recorded` reads files back for others.
"""
