"""The environments of the benchmark, one a file, and the loop that records them."""
