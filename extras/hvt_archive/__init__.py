"""Tools for recordings after the flight: `exports` for other programs, `replay` with other models.

Each is a command of ``hvt-ground`` behind the entry point ``hvt.ground_commands``; nothing of the ground imports one.
"""
