"""The results of a run: numbers from arrivals, summaries and samples, whether bars hold, a table and a picture."""
