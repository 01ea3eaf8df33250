"""A test that kills commands at random moments and runs them again: see ``docs/robustness.md``."""
