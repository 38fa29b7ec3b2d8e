"""How well an instrument can do before it is built: bound, budget, design."""
