"""What a ground may ask for (`commands`), and what the state of the link decides (`link_control`)."""
