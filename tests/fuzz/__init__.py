"""A fuzzer for every file that dmbench reads: see ``docs/robustness.md``."""
