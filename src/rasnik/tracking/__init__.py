"""Following a mask through a stream of frames, at camera rate and at the bound."""
