"""An edge's reports on itself: `state` is one value, made each second by its loop; `status` has the views of it."""
