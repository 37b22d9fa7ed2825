"""Makes the training pictures: drawn places, views and crops of them, and the pool on disk."""
