"""One ground with many edges: ``python -m bench.fleet``; `played` plays the edges."""
