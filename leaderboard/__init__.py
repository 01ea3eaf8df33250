"""The paper's tables, entries of results, and the static page made from them."""
