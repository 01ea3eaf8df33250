"""The environments of the benchmark, each a file or a folder, and the policies that record them."""
