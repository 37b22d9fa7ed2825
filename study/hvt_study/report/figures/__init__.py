"""Figures of the report in Matplotlib, each a function of a `Setting`, and the plot of ``hvt-study compare``."""
