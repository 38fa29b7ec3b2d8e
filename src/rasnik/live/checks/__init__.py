"""What `rasnik doctor` looks at: one small function for each thing, findings with a remedy."""
