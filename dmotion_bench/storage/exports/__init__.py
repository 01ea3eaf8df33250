"""Data sets of the format ``dmbench/1``, written in the formats of other tools."""
