"""Recordings on disk over months: their index, and their removal.

`folder` keeps the index of a folder and removes what is due, `retention` says what is, `command` lists and finds.
"""
