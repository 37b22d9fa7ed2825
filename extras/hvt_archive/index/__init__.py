"""Recordings on disk over months: their index, and their removal.

`folder` keeps the index of a folder and removes old files, `retention` says which, `command` lists and finds.
"""
