"""What comes off the link, put in order and counted. Pure: no Zenoh, no threads, time is an argument."""
