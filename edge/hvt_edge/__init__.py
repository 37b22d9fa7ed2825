"""The edge side: camera to link."""
