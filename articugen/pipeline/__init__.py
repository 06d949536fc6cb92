"""A job to a data set."""
