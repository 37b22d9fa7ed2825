"""Requests of a ground (`commands`), and decisions by the state of the link (`link_control`)."""
