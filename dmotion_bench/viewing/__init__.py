"""Data sets, runs and reports in Rerun."""
