"""Paints the scene: ground, plants, the cast of vehicles and people (`CLASS_NAMES`), and their shadows."""
