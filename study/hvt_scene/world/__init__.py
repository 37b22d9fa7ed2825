"""What is in the drawn world and where: the plan of streets, houses and fields, and the traffic on them."""
