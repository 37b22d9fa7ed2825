"""Cursor on Target: the camera and the tracks of a session as events for ATAK, WinTAK and TAK Server.

`reporter` makes events of Cursor on Target from those of a session, `event` is one and its XML, `type_table` says
which class is of which type, and `connection` sends them.
"""
