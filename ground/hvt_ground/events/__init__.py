"""What happened, as values: the language that all rooms of the ground speak."""
