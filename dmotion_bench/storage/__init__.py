"""MCAP data sets of the format ``dmbench/1``: schema, writer, reader, repair, import, frame cache."""
