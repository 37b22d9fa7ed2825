"""The edge side, camera to link: `app.Edge` is all of it, `wiring` builds its parts."""
