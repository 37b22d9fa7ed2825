"""Cursor on Target: the camera and the tracks of a session as events for ATAK, WinTAK and TAK Server.

`reporter` makes events of Cursor on Target from those of a session, `event` is one, its XML and
its type, and `connection` sends them.
"""
