"""Deliberate faults that the test suite must notice."""
