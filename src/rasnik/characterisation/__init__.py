"""How good a measurement is: from images and tracks of the instrument itself."""
