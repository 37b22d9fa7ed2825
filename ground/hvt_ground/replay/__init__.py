"""Receives again what a ground has received and kept: `command` plays a file of ``hvt-ground --log``."""
