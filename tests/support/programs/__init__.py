"""Starts hvt-edge and hvt-ground as processes, listens to them, and reads what they leave."""
