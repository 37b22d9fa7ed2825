"""The Rerun recording and live view: `Recorder` writes one session, `LiveView` is the viewer that may watch."""
