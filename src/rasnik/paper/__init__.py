"""The figures and numbers of the paper, done again by this software."""
