"""Tables of figures as data, what making one costs, and what of it is still to be done."""
