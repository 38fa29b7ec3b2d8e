"""Where mask, lens and sensor stand, from what Rasniks read; and bodies that many of them join."""
