"""Paints what is there: ground, plants, vehicles and people, and their shadows."""
