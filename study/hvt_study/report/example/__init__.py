"""The flight that a report shows in pictures: `choose_run`, `fly_again`, `load_example`, `save_example`."""
