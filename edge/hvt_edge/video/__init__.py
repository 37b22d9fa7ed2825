"""The base stream: x265, its rate, frame rate, regions and keyframes, and a local copy of it."""
