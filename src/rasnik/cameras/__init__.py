"""Sources of frames: cameras, recordings, simulations."""
