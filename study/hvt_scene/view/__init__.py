"""From the world to pixels: the camera on its way, projection, and composition of ground and sprites."""
