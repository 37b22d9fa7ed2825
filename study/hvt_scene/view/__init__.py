"""From the world to pixels: the camera on its way, projection, and picture out of ground and sprites."""
