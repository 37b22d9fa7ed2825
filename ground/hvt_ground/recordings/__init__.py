"""Recordings on disk over months: split files, their index, and their removal.

`session_files` writes those of one session and says of each what a `row` has, `folder` keeps the index of a folder
and removes what is due, `retention` says what is, `command` lists and finds, `recorded` reads files back for others.
"""
