"""What is in the drawn world and where: streets, houses, fields, and who drives on them when."""
