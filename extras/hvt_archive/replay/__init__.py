"""Receives again a ground's stored messages: `command` plays a file of ``hvt-ground --log``."""
