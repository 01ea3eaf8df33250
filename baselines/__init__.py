"""The models of the benchmark, one paper a file."""
