"""What an edge says of itself: `state` is one value, made each second by its loop; `status` has the views of it."""
