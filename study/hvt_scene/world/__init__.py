"""The drawn world: the plan of streets, houses and fields, and the traffic on them."""
