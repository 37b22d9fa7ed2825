"""What comes off the link, put in order and counted: `Reassembler`, statistics, packets, windows of numbers. Pure."""
