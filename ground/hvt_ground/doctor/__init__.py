"""``hvt-ground doctor``: whether a ground with these settings could start, and what it would lack. See `command`."""
