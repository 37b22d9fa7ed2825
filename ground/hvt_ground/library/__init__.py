"""The ground as a part of another program: `received` gives it what comes."""
