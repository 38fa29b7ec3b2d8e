"""Results for the eye: numbers with their errors, overlays, the demonstration."""
