"""The page to look at, and the interface for programs behind it."""
