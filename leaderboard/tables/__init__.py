"""The tables that ``dmbench reproduce`` knows, one a file (``dmotion_bench.reproduction.table``)."""
