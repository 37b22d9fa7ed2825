"""Flights of the drawn scene that edges and a ground left in a folder, side by side: their tracks and pictures.

`Compared`, `compare_flown`, `write_picture`.
"""
