"""Makes what the models are trained on: drawn places, views and crops of them, and the pool on disk."""
