"""Keys and rights of a fleet: a small certificate authority, and Zenoh configurations that let nobody do more."""
