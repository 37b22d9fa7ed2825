"""The files of a session's recording: `session_files` writes them and tells the facts of each, a `row`.

Extras that read recordings back give others `Recorded`.
"""
