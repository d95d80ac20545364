"""One extension of facediff of every kind."""
