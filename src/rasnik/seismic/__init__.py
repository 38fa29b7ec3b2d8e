"""Ground motion from the displacement of a suspended mass, and what limits it."""
