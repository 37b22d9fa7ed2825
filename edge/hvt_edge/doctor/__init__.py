"""``hvt-edge doctor``: whether a flight with these settings could start, and what it would lack. See `command`."""
