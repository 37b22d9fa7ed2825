"""The .rrd file itself: whole at every moment, bounded, complete at its end."""
