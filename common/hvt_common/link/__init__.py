"""Everything that knows Zenoh and bytes."""
