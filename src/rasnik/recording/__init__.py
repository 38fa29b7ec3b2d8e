"""What is measured on its way to the disk: tracks without end, and frames around events."""
