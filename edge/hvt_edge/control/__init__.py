"""What a ground may ask for, and what the state of the link decides."""
