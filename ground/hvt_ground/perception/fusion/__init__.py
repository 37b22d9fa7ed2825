"""One list of tracks out of base, edge and stills: `fuse`, moved along the `CameraPath` of `entity`."""
