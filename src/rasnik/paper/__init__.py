"""The figures and numbers of the paper, made again."""
