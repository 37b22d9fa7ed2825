"""``hvt-ground doctor``: whether a ground with these settings could start, and why not. See `command`."""
