"""Episodes of a data set for learning, compared with each other."""
