"""``hvt-edge doctor``: whether a flight with these settings could start, and why not. See `command`."""
