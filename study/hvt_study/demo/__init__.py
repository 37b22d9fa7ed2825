"""Flights of the drawn scene that edges and a ground left in a folder, side by side: what each knew and showed.

`Compared`, `compare_flown`, `write_picture`.
"""
