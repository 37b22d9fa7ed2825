"""The Rerun recording and live view: what is written, and how the screen is laid out."""
