"""What the benchmarks share: pictures and clips (`material`), programs with their time and memory (`processes`)."""
