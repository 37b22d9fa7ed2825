"""The edge's end of the link: the one transmitter, budget, pacing, rate control, and who receives."""
