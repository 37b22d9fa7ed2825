"""The files of a session's recording: `session_files` writes them and says of each what a `row` has.

Extras that read recordings back give others `Recorded`.
"""
