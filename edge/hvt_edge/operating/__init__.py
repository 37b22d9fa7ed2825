"""What changes in flight: everybody reads it, one owner writes it."""
