"""What a recording shows of stills: pairs in a gallery, patches on the picture; others use `rows` and `gallery`."""
