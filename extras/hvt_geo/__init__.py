"""Places of objects on the ground: from the pose of a camera, on flat ground or an elevation model."""
