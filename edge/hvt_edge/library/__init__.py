"""The edge as a part of another program: `pushed` takes the frames that it has."""
