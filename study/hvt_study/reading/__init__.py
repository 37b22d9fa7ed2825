"""Legibility at the ground, for the same bits: codes on roofs, by a reader that knows nothing of HVT.

`ReadPlan`, `compare_codes`.
"""
