"""Receives again a ground's stored messages: `message_log` writes and reads them, `command` plays a file."""
